// The crop box: six sides, drawn over the picture and saved in the run.

import type { Connection } from "./connection";
import type { Box6 } from "./stage";
import { element, input, make, onClick } from "./dom";

const AXES = ["x", "y", "z"] as const;

export class CropBox {
  private box: Box6 = [-1, -1, -1, 1, 1, 1];
  private bounds: Box6 = [-1, -1, -1, 1, 1, 1];

  /** `changed` is called with the box, or null if nothing is cropped. */
  constructor(connection: Connection, private readonly changed: (clip: Box6 | null) => void) {
    input("crop").addEventListener("change", () => this.show());
    onClick("crop-save", () => connection.send({ kind: "crop", clip: this.clip }));
    onClick("crop-reset", () => {
      this.box = [...this.bounds];
      this.fill();
      this.show();
    });
  }

  /** The visible box; null: the whole scene. */
  get clip(): Box6 | null {
    return input("crop").checked ? this.box : null;
  }

  /** The box's center, about which the camera turns. */
  get middle(): [number, number, number] {
    const half = (k: number) => (this.box[k]! + this.box[k + 3]!) / 2;
    return [half(0), half(1), half(2)];
  }

  set(bounds: Box6, kept: Box6 | null, focus: [number, number, number], distance: number): void {
    this.bounds = bounds;
    this.box = kept ?? inner(bounds, focus, distance);
    input("crop").checked = kept !== null;
    this.fill();
    this.show();
  }

  toggle(): void {
    input("crop").checked = !input("crop").checked;
    this.show();
  }

  private show(): void {
    element("card-crop").classList.toggle("on", this.clip !== null);
    element("tool-crop").setAttribute("aria-pressed", String(this.clip !== null));
    this.changed(this.clip);
  }

  /** A row for each axis, with a handle for each of its ends. */
  private fill(): void {
    element("crop-sides").replaceChildren(...AXES.map((axis, k) => {
      const ends = make("span", { className: "ends" }, this.side(k), this.side(k + 3));
      const row = make("div", { className: `axis ${axis}` }, make("span", { className: "name", textContent: axis.toUpperCase() }), ends);
      row.append(make("output", { id: `crop-${axis}-out` }));
      return row;
    }));
    AXES.forEach((_, k) => this.tell(k));
  }

  private side(k: number): HTMLInputElement {
    const axis = k % 3;
    const range = make("input", { type: "range", id: `crop-${AXES[axis]}${k < 3 ? 0 : 1}` });
    [range.min, range.max, range.step] = [String(this.bounds[axis]), String(this.bounds[axis + 3]), "any"];
    range.value = String(this.box[k]);
    range.setAttribute("aria-label", `${AXES[axis]} ${k < 3 ? "from" : "to"}`);
    range.addEventListener("input", () => {
      const other = this.box[(k + 3) % 6]!;
      const gap = (this.bounds[axis + 3]! - this.bounds[axis]!) * 0.01;
      const v = Number(range.value);
      this.box[k] = k < 3 ? Math.min(v, other - gap) : Math.max(v, other + gap);
      range.value = String(this.box[k]);
      input("crop").checked = true;
      this.tell(axis);
      this.show();
    });
    return range;
  }

  private tell(axis: number): void {
    const [low, high] = [this.box[axis]!, this.box[axis + 3]!];
    element(`crop-${AXES[axis]}-out`).textContent = `${low.toFixed(2)} … ${high.toFixed(2)}`;
    const ends = element(`crop-${AXES[axis]}0`).parentElement;
    const [from, size] = [this.bounds[axis]!, this.bounds[axis + 3]! - this.bounds[axis]!];
    ends?.style.setProperty("--from", `${(100 * (low - from)) / size}%`);
    ends?.style.setProperty("--to", `${(100 * (high - from)) / size}%`);
  }
}

/** The middle part of the region that can be shown, at most as wide as the cameras' distance. */
function inner(bounds: Box6, focus: [number, number, number], distance: number): Box6 {
  const low = (k: 0 | 1 | 2) => Math.max(bounds[k], focus[k] - distance / 2);
  const high = (k: 0 | 1 | 2) => Math.min(bounds[k + 3]!, focus[k] + distance / 2);
  return [low(0), low(1), low(2), high(0), high(1), high(2)];
}
