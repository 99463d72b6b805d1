// How far training is: figures, a bar, and a small curve of PSNR.

import type { Connection, Told } from "./connection";
import { element, svg } from "./dom";

interface Point {
  step: number;
  psnr: number;
  heldOut: number | null;
}

/** Points of the curve; of more, every second is dropped. */
const MOST = 400;
const [WIDTH, HEIGHT] = [272, 64];

export class Training {
  private points: Point[] = [];

  /** `running` tells whether the field changes. */
  constructor(connection: Connection, private readonly running: (on: boolean) => void) {
    connection.on("status", (t) => this.show(t));
  }

  private show(t: Told<"status">): void {
    document.body.dataset.step = String(t.step);
    document.body.dataset.running = String(t.running);
    this.running(t.running);
    const known = t.step > 0 || t.running;
    element("card-training").hidden = !known;
    element("status").hidden = !known;
    element("status-text").textContent = t.running ? `Training · step ${group(t.step)}` : `Step ${group(t.step)}`;
    const rows: [string, string | null][] = [
      ["step", group(t.step)],
      ["loss", t.loss > 0 ? t.loss.toPrecision(3) : null],
      ["psnr", t.psnr > 0 ? `${t.psnr.toFixed(2)} dB` : null],
      ["held-out", t.held_out === null ? null : `${t.held_out.toFixed(2)} dB`],
      ["rays", t.rays_per_s > 0 ? group(Math.round(t.rays_per_s)) : null],
      ["time", t.seconds > 0 ? duration(t.seconds) : null],
    ];
    for (const [name, text] of rows) {
      element(`figure-${name}`).textContent = text ?? "";
      element(`row-${name}`).hidden = text === null;
    }
    element("training-state").textContent = t.running ? `${Math.round(100 * t.progress)} %` : "finished";
    element("training-progress").hidden = !t.running;
    element("training-bar").style.width = `${100 * t.progress}%`;
    this.add(t);
  }

  private add(t: Told<"status">): void {
    const last = this.points.at(-1);
    // Another run begins anew.
    if (last && t.step < last.step) this.points = [];
    if (t.psnr > 0 && t.step !== last?.step) this.points.push({ step: t.step, psnr: t.psnr, heldOut: t.held_out });
    if (this.points.length > MOST) this.points = this.points.filter((_, i) => i % 2 === 0 || i === this.points.length - 1);
    element("curve").hidden = this.points.length < 2;
    if (this.points.length > 1) this.draw();
  }

  private draw(): void {
    const [first, last] = [this.points[0]!, this.points.at(-1)!];
    const values = this.points.flatMap((p) => [p.psnr, ...(p.heldOut === null ? [] : [p.heldOut])]);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const x = (p: Point) => 2 + ((WIDTH - 4) * (p.step - first.step)) / Math.max(1, last.step - first.step);
    const y = (v: number) => HEIGHT - 4 - ((HEIGHT - 8) * (v - low)) / Math.max(0.1, high - low);
    const line = (name: string, of: (p: Point) => number | null) => {
      const places = this.points.flatMap((p) => {
        const v = of(p);
        return v === null ? [] : [`${x(p).toFixed(1)},${y(v).toFixed(1)}`];
      });
      return svg("polyline", { class: name, points: places.join(" ") });
    };
    const curve = element<SVGElement>("curve-lines");
    curve.replaceChildren(line("psnr", (p) => p.psnr), line("held-out", (p) => p.heldOut));
    element("curve-low").textContent = `${low.toFixed(1)} dB`;
    element("curve-high").textContent = `${high.toFixed(1)} dB`;
  }
}

const group = (n: number) => String(n).replace(/\B(?=(\d{3})+$)/g, "\u202f");

function duration(seconds: number): string {
  const s = Math.round(seconds);
  const two = (n: number) => String(n).padStart(2, "0");
  return s < 3600 ? `${Math.floor(s / 60)}:${two(s % 60)} min` : `${Math.floor(s / 3600)}:${two(Math.floor(s / 60) % 60)} h`;
}
