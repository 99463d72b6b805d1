// The overlay: cameras, crop box, path and mesh, drawn over the picture in its perspective.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import type { Photograph, View } from "./messages";

/** Lowest and highest corner in the world. */
export type Box6 = NonNullable<View["clip"]>;
export type Pose = View["pose"];

/** World from a three.js camera (looking along -z, y up), from `world_from_camera` rows (looking along z, y down). */
export function matrixOf(pose: number[]): THREE.Matrix4 {
  const p = pose as [number, number, number, number, number, number, number, number, number, number, number, number];
  return new THREE.Matrix4().set(p[0], -p[1], -p[2], p[3], p[4], -p[5], -p[6], p[7], p[8], -p[9], -p[10], p[11], 0, 0, 0, 1);
}

export function poseOf(m: THREE.Matrix4): Pose {
  const e = m.elements;
  return [e[0], -e[4], -e[8], e[12], e[1], -e[5], -e[9], e[13], e[2], -e[6], -e[10], e[14]];
}

export class Stage {
  readonly camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000);
  readonly controls: OrbitControls;
  private readonly scene = new THREE.Scene();
  private readonly renderer: THREE.WebGLRenderer | null;
  private readonly frusta = new THREE.Group();
  private readonly path = new THREE.Group();
  private readonly rule = new THREE.Group();
  private readonly box: THREE.Box3Helper;
  private mesh: THREE.Object3D | null = null;
  private changed = true;

  constructor(canvas: HTMLCanvasElement) {
    // Without WebGL only the picture is shown, which the program renders.
    try {
      this.renderer = new THREE.WebGLRenderer({ canvas, alpha: true, antialias: true, preserveDrawingBuffer: true });
      this.renderer.setClearColor(0, 0);
    } catch {
      this.renderer = null;
    }
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.controls.dampingFactor = 0.2;
    this.controls.addEventListener("change", () => (this.changed = true));
    this.box = new THREE.Box3Helper(new THREE.Box3(), 0xffcc44);
    this.box.visible = false;
    this.scene.add(this.frusta, this.path, this.rule, this.box);
  }

  get hasOverlay(): boolean {
    return this.renderer !== null;
  }

  /** Whether there is an overlay. */
  get hasSomething(): boolean {
    const filled = (g: THREE.Group) => g.visible && g.children.length > 0;
    return this.box.visible || Boolean(this.mesh?.visible) || [this.frusta, this.path, this.rule].some(filled);
  }

  resize(width: number, height: number): void {
    this.renderer?.setPixelRatio(window.devicePixelRatio);
    this.renderer?.setSize(width, height, false);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
  }

  /** Draws if anything has changed. */
  draw(): void {
    if (this.changed) this.renderer?.render(this.scene, this.camera);
    this.changed = false;
  }

  touch(): void {
    this.changed = true;
  }

  /** Sets the camera pose; the camera then turns about a point at `distance` in front of it. */
  lookFrom(matrix: THREE.Matrix4, distance: number): void {
    const position = new THREE.Vector3().setFromMatrixPosition(matrix);
    const forward = new THREE.Vector3(0, 0, -1).transformDirection(matrix);
    // Cancels the damped rest of a drag, which would move the camera away from its new pose.
    const { enableDamping } = this.controls;
    this.controls.enableDamping = false;
    this.controls.update();
    this.controls.enableDamping = enableDamping;
    this.camera.position.copy(position);
    this.controls.target.copy(position).addScaledVector(forward, distance);
    this.controls.update();
  }

  /** Moves the camera right, up and forward. */
  fly(right: number, up: number, forward: number, step: number): void {
    const by = new THREE.Vector3(right, 0, -forward).applyQuaternion(this.camera.quaternion);
    by.z += up;
    by.setLength(step);
    this.camera.position.add(by);
    this.controls.target.add(by);
  }

  pose(): Pose {
    this.camera.updateMatrixWorld();
    return poseOf(this.camera.matrixWorld);
  }

  showPhotographs(photographs: Photograph[], size: number): void {
    this.frusta.clear();
    for (const held of [false, true]) {
      const points: number[] = [];
      for (const p of photographs.filter((p) => p.held_out === held)) {
        const m = matrixOf(p.pose);
        const h = Math.tan(p.fov_y / 2) * size;
        const w = h * p.aspect;
        const eye = new THREE.Vector3().setFromMatrixPosition(m);
        const corners = [[-w, -h], [w, -h], [w, h], [-w, h]].map(([x, y]) => new THREE.Vector3(x, y, -size).applyMatrix4(m));
        corners.forEach((c, k) => points.push(...eye.toArray(), ...c.toArray(), ...c.toArray(), ...corners[(k + 1) % 4]!.toArray()));
      }
      this.frusta.add(lines(points, held ? 0xff6b57 : 0x5b9dff));
    }
    this.changed = true;
  }

  showFrusta(on: boolean): void {
    this.frusta.visible = on;
    this.changed = true;
  }

  showBox(box: Box6 | null): void {
    this.box.visible = box !== null;
    if (box) {
      this.box.box.min.set(box[0], box[1], box[2]);
      this.box.box.max.set(box[3], box[4], box[5]);
    }
    this.changed = true;
  }

  showPath(points: THREE.Vector3[]): void {
    this.path.clear();
    if (points.length > 1) {
      const material = new THREE.LineBasicMaterial({ color: 0x66ff99, depthTest: false });
      this.path.add(new THREE.Line(new THREE.BufferGeometry().setFromPoints(points), material));
    }
    this.changed = true;
  }

  /** Shows one or two picked points, and the line between them. */
  showRule(points: number[][], size: number): void {
    this.rule.clear();
    const material = new THREE.MeshBasicMaterial({ color: 0xff4fd8, depthTest: false });
    for (const p of points) {
      const ball = new THREE.Mesh(new THREE.SphereGeometry(size, 12, 8), material);
      ball.position.set(p[0]!, p[1]!, p[2]!);
      this.rule.add(ball);
    }
    if (points.length === 2) {
      const line = new THREE.BufferGeometry().setFromPoints(points.map((p) => new THREE.Vector3(p[0], p[1], p[2])));
      this.rule.add(new THREE.Line(line, new THREE.LineBasicMaterial({ color: 0xff4fd8, depthTest: false })));
    }
    this.changed = true;
  }

  /** Shows a mesh with `scale` meters per unit of the capture; `rows` map the capture's frame to the world. */
  async loadMesh(url: string, rows: number[], scale: number): Promise<void> {
    const made = await new GLTFLoader().loadAsync(url);
    if (this.mesh) this.scene.remove(this.mesh);
    this.mesh = made.scene;
    // glTF is y up; the world here is z up.
    const r = rows as [number, number, number, number, number, number, number, number, number, number, number, number];
    this.mesh.matrixAutoUpdate = false;
    this.mesh.matrix.set(...r, 0, 0, 0, 1).multiply(new THREE.Matrix4().makeRotationX(Math.PI / 2));
    this.mesh.matrix.multiply(new THREE.Matrix4().makeScale(1 / scale, 1 / scale, 1 / scale));
    this.scene.add(this.mesh);
  }

  showMesh(on: boolean): void {
    if (this.mesh) this.mesh.visible = on;
    this.changed = true;
  }
}

function lines(points: number[], color: number): THREE.LineSegments {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color }));
}
