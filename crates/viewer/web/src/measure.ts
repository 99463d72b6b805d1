// The ruler: two picked points whose true distance sets the scale of meshes.

import type { View } from "./messages";
import type { Connection } from "./connection";
import type { Notices } from "./notices";
import { Stage } from "./stage";
import { element, input, onClick, select } from "./dom";

/** Pixels that the pointer may move during a click. */
const CLICK = 4;

export class Ruler {
  private points: number[][] = [];
  private picking = false;
  private unit = 1;
  private size = 0.02;
  private pressed: [number, number] = [0, 0];

  /** `describe` returns the view at a given size, in which a pixel is picked. */
  constructor(
    private readonly connection: Connection,
    private readonly stage: Stage,
    private readonly notices: Notices,
    private readonly describe: (width: number, height: number) => View,
  ) {
    onClick("measure", () => this.toggle());
    onClick("measure-clear", () => {
      this.points = [];
      this.stop();
      connection.send({ kind: "measured", points: null, metres: 1 });
    });
    onClick("measure-save", () => this.save());
    const overlay = element("overlay");
    overlay.addEventListener("pointerdown", (e) => (this.pressed = [e.clientX, e.clientY]));
    overlay.addEventListener("pointerup", (e) => {
      // A drag turns, a click picks.
      if (this.picking && Math.hypot(e.clientX - this.pressed[0], e.clientY - this.pressed[1]) < CLICK) this.pick(e);
    });
    connection.on("picked", (t) => {
      if (!t.point) notices.say("There is no surface here: click on the object", "error");
      else if (this.points.push(t.point) === 2) this.picking = false;
      this.show();
    });
  }

  /** `unit`: length of one unit of the capture in the world. */
  set(measured: number[] | null, unit: number, distance: number): void {
    [this.unit, this.size] = [unit, distance * 0.006];
    if (measured) {
      this.points = [measured.slice(0, 3), measured.slice(3, 6)];
      input("measure-length").value = String(Number((measured[6]! * 100).toPrecision(6)));
      select("measure-unit").value = "0.01";
    }
    this.show();
  }

  /** Starts or stops picking two points. */
  toggle(): void {
    if (this.picking) return this.stop();
    this.points = [];
    this.picking = true;
    this.show();
  }

  stop(): void {
    this.picking = false;
    this.show();
  }

  private pick(e: PointerEvent): void {
    const box = element("overlay").getBoundingClientRect();
    const view = this.describe(Math.round(box.width), Math.round(box.height));
    this.connection.send({ kind: "pick", x: e.clientX - box.left, y: e.clientY - box.top, view });
  }

  private save(): void {
    const metres = Number(input("measure-length").value) * Number(select("measure-unit").value);
    const [a, b] = this.points;
    if (!a || !b) this.notices.say("Pick two points first", "error");
    else this.connection.send({ kind: "measured", points: [...a, ...b] as [number, number, number, number, number, number], metres });
  }

  private show(): void {
    this.stage.showRule(this.points, this.size);
    const [a, b] = this.points;
    const apart = a && b ? Math.hypot(...a.map((v, k) => v - b[k]!)) / this.unit : 0;
    element("measure-note").textContent = a && b
      ? `${apart.toPrecision(4)} units of the capture apart`
      : this.picking ? `Click the ${a ? "second" : "first"} point in the picture.` : "Pick both ends of a length that you know.";
    document.body.classList.toggle("picking", this.picking);
    for (const id of ["measure", "tool-measure"]) element(id).setAttribute("aria-pressed", String(this.picking));
    element("measure-label").textContent = this.picking ? "Stop picking" : "Pick two points";
  }
}
