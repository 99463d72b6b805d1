// The axes in the corner: they show the orientation of the camera, and a click looks along an axis.

import * as THREE from "three";
import { element, svg } from "./dom";

const AXES: [string, THREE.Vector3][] = [
  ["x", new THREE.Vector3(1, 0, 0)],
  ["y", new THREE.Vector3(0, 1, 0)],
  ["z", new THREE.Vector3(0, 0, 1)],
];
const REACH = 27;

interface Arm {
  direction: THREE.Vector3;
  ball: SVGElement;
  line: SVGElement | null;
}

export class Gizmo {
  private readonly place = element<SVGElement>("gizmo");
  private readonly arms: Arm[] = [];
  private last = "";

  constructor(lookAlong: (axis: THREE.Vector3) => void) {
    for (const [name, axis] of AXES) {
      for (const sign of [1, -1]) {
        const label = `Look from ${sign < 0 ? "−" : "+"}${name.toUpperCase()}`;
        const ball = svg("g", { class: `${name}${sign < 0 ? " minus" : ""}`, role: "button", tabindex: 0, "aria-label": label });
        const title = svg("title", {});
        title.textContent = label;
        ball.append(title, svg("circle", { r: sign < 0 ? 5 : 8 }));
        if (sign > 0) {
          const text = svg("text", { "text-anchor": "middle", dy: "0.36em" });
          text.textContent = name.toUpperCase();
          ball.append(text);
        }
        const direction = axis.clone().multiplyScalar(sign);
        ball.addEventListener("click", () => lookAlong(direction));
        ball.addEventListener("keydown", (e) => e.key === "Enter" && lookAlong(direction));
        const line = sign > 0 ? svg("line", { class: name, x1: 0, y1: 0 }) : null;
        this.arms.push({ direction, ball, line });
      }
    }
  }

  /** Rotates the axes with the camera; the nearest is drawn last, on top. */
  turn(camera: THREE.Camera): void {
    const turned = camera.quaternion.clone().invert();
    const now = turned.toArray().map((v) => v.toFixed(3)).join();
    if (now === this.last) return;
    this.last = now;
    const seen = this.arms.map((arm) => ({ arm, at: arm.direction.clone().applyQuaternion(turned) })).sort((a, b) => a.at.z - b.at.z);
    const focused = document.activeElement;
    for (const { arm, at } of seen) {
      const [x, y] = [at.x * REACH, -at.y * REACH];
      arm.line?.setAttribute("x2", x.toFixed(1));
      arm.line?.setAttribute("y2", y.toFixed(1));
      arm.ball.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
      if (arm.line) this.place.append(arm.line);
      this.place.append(arm.ball);
    }
    if (focused instanceof SVGElement && this.place.contains(focused)) focused.focus();
  }
}
