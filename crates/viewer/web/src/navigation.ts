// Camera movement: poses of photographs, flying with keys, field of view, and smooth transitions.

import * as THREE from "three";
import type { Photograph } from "./messages";
import { type Key, at } from "./path";
import { Stage, matrixOf } from "./stage";
import { element, input } from "./dom";
import { writes } from "./shortcuts";

/** Milliseconds of a smooth transition. */
const TRANSITION = 450;
/** Largest field of view in degrees, as on the slider. */
const WIDEST = 110;
const FLYING = "wasdqe";

export class Navigation {
  /** Distance of the cameras from the point that they look at. */
  distance = 4;
  private focus: [number, number, number] = [0, 0, 0];
  private home: Key | null = null;
  private flown = 0;
  private way: { from: Key; to: Key; begun: number } | null = null;
  /** Keys that are held: w a s d fly, q and e move down and up. */
  private readonly held = new Set<string>();

  /** `moved` is called whenever the camera has moved. */
  constructor(private readonly stage: Stage, private readonly moved: () => void) {
    stage.controls.addEventListener("change", () => this.moved());
    stage.controls.addEventListener("start", () => (this.way = null));
    window.addEventListener("keydown", (e) => {
      if (writes(e.target) || e.ctrlKey || e.metaKey || e.altKey || element<HTMLDialogElement>("help").open) return;
      if (FLYING.includes(e.key.toLowerCase())) this.held.add(e.key.toLowerCase());
    });
    window.addEventListener("keyup", (e) => this.held.delete(e.key.toLowerCase()));
    window.addEventListener("blur", () => this.held.clear());
    input("fov").addEventListener("input", () => {
      this.setFov(Number(input("fov").value));
      this.moved();
    });
  }

  /** Sets a scene's focus; for the first scene the camera moves to its home pose. */
  set(focus: [number, number, number], distance: number, first: Photograph | undefined, goHome: boolean): void {
    [this.focus, this.distance] = [focus, distance];
    // Camera outlines close to the viewpoint would hide everything.
    this.stage.camera.near = distance * 0.1;
    this.stage.camera.far = distance * 50;
    if (first) this.home = this.keyOf(first);
    else {
      const eye = new THREE.Vector3(...focus).addScaledVector(new THREE.Vector3(1, -1, 0.6).normalize(), distance);
      const turn = new THREE.Matrix4().lookAt(eye, new THREE.Vector3(...focus), new THREE.Vector3(0, 0, 1));
      this.home = { matrix: turn.setPosition(eye), fov: 50 };
    }
    if (goHome) {
      this.stage.controls.target.set(...focus);
      this.standAt(this.home);
    }
  }

  /** The camera as a keyframe of a path. */
  get key(): Key {
    this.stage.camera.updateMatrixWorld();
    return { matrix: this.stage.camera.matrixWorld.clone(), fov: this.stage.camera.fov };
  }

  goHome(): void {
    if (this.home) this.goTo(this.home);
  }

  lookFrom(p: Photograph): void {
    this.goTo(this.keyOf(p));
  }

  /** Turns the camera toward the center of the scene. */
  lookAtFocus(focus = this.focus): void {
    this.stage.controls.target.set(...focus);
    this.moved();
  }

  /** Looks along an axis of the world at the focus. */
  lookAlong(axis: THREE.Vector3): void {
    const target = this.stage.controls.target.clone();
    // Right from above, up would have no direction.
    const from = axis.clone().add(new THREE.Vector3(0, axis.z === 0 ? 0 : -1e-3, 0)).normalize();
    const eye = target.clone().addScaledVector(from, this.stage.camera.position.distanceTo(target));
    const turn = new THREE.Matrix4().lookAt(eye, target, new THREE.Vector3(0, 0, 1));
    this.goTo({ matrix: turn.setPosition(eye), fov: this.stage.camera.fov });
  }

  /** Moves to a keyframe smoothly, or at once if the user prefers reduced motion. */
  goTo(to: Key): void {
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) this.standAt(to);
    else this.way = { from: this.key, to, begun: performance.now() };
  }

  standAt(k: Key): void {
    this.way = null;
    this.setFov(k.fov);
    this.stage.lookFrom(k.matrix, this.distance);
    this.moved();
  }

  tick(now: number): void {
    const seconds = Math.min((now - this.flown) / 1000, 0.1);
    this.flown = now;
    if (this.way) {
      const { from, to, begun } = this.way;
      const t = Math.min(1, (now - begun) / TRANSITION);
      const way = this.way;
      this.standAt(t < 1 ? at([from, to], t * t * (3 - 2 * t), false) : to);
      if (t < 1) this.way = way;
    }
    if (this.held.size === 0) return;
    const axis = (plus: string, minus: string) => Number(this.held.has(plus)) - Number(this.held.has(minus));
    const by = [axis("d", "a"), axis("e", "q"), axis("w", "s")] as const;
    if (by.every((v) => v === 0)) return;
    this.way = null;
    this.stage.fly(...by, (this.distance / 3) * seconds);
    this.moved();
  }

  /** Adjusts the field of view after the window was resized, so that its shorter side shows the same angle. `aspect`: the former aspect ratio. */
  keepShown(aspect: number): void {
    const { camera } = this.stage;
    const half = Math.tan((camera.fov * Math.PI) / 360) * (Math.min(1, aspect) / Math.min(1, camera.aspect));
    this.setFov(Math.min(WIDEST, degrees(2 * Math.atan(half))));
  }

  /** The pose of a photograph, with a field of view that shows all of it in any window. */
  private keyOf(p: Photograph): Key {
    const wider = Math.max(1, p.aspect / this.stage.camera.aspect);
    return { matrix: matrixOf(p.pose), fov: Math.min(WIDEST, degrees(2 * Math.atan(Math.tan(p.fov_y / 2) * wider))) };
  }

  private setFov(fov: number): void {
    this.stage.camera.fov = fov;
    this.stage.camera.updateProjectionMatrix();
    input("fov").value = String(Math.round(fov));
    element("fov-out").textContent = `${Math.round(fov)}°`;
  }
}

const degrees = (radians: number) => (radians * 180) / Math.PI;
