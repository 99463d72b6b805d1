// Progress of training: figures, a bar, and a small curve of PSNR.

import type { Connection, Received } from "./connection";
import { element, svg } from "./dom";

interface Point {
  step: number;
  psnr: number | null;
  heldOut: number | null;
}

/** Most points of the curve; when there are more, every second one is dropped. */
const MOST = 400;
const [WIDTH, HEIGHT] = [272, 64];

export class Training {
  private points: Point[] = [];

  /** `running` is called with whether training is running. */
  constructor(connection: Connection, private readonly running: (on: boolean) => void) {
    connection.on("status", (t) => this.show(t));
    connection.on("history", (t) => {
      this.points = t.points.map(([step, psnr, heldOut]) => ({ step, psnr, heldOut }));
      this.draw();
    });
  }

  private show(t: Received<"status">): void {
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

  private add(t: Received<"status">): void {
    const last = this.points.at(-1);
    if (!t.running || t.psnr <= 0 || t.step === last?.step) return;
    // Another run starts with an empty curve.
    if (last && t.step < last.step) this.points = [];
    const before = this.points.filter((p) => p.heldOut !== null).at(-1)?.heldOut ?? null;
    this.points.push({ step: t.step, psnr: t.psnr, heldOut: t.held_out === before ? null : t.held_out });
    if (this.points.length > MOST) this.points = this.points.filter((p, i) => i % 2 === 0 || p.heldOut !== null || i === this.points.length - 1);
    this.draw();
  }

  private draw(): void {
    const values = this.points.flatMap((p) => [p.psnr, p.heldOut]).filter((v) => v !== null);
    element("curve").hidden = values.length < 2;
    const [first, last] = [this.points[0], this.points.at(-1)];
    if (!first || !last || values.length < 2) return;
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const x = (p: Point) => 5 + ((WIDTH - 10) * (p.step - first.step)) / Math.max(1, last.step - first.step);
    const y = (v: number) => HEIGHT - 6 - ((HEIGHT - 12) * (v - low)) / Math.max(0.1, high - low);
    const places = (of: (p: Point) => number | null) => this.points.flatMap((p) => {
      const v = of(p);
      return v === null ? [] : [[x(p).toFixed(1), y(v).toFixed(1)] as const];
    });
    const line = (name: string, at: (readonly [string, string])[]) => svg("polyline", { class: name, points: at.map((p) => p.join()).join(" ") });
    const held = places((p) => p.heldOut);
    const dots = held.map(([cx, cy]) => svg("circle", { class: "held-out", cx, cy, r: 2.4 }));
    element<SVGElement>("curve-lines").replaceChildren(line("psnr", places((p) => p.psnr)), line("held-out", held), ...dots);
    element("curve-low").textContent = low.toFixed(1);
    element("curve-high").textContent = `${high.toFixed(1)} dB`;
  }
}

const group = (n: number) => String(n).replace(/\B(?=(\d{3})+$)/g, "\u202f");

function duration(seconds: number): string {
  const s = Math.round(seconds);
  const two = (n: number) => String(n).padStart(2, "0");
  return s < 3600 ? `${Math.floor(s / 60)}:${two(s % 60)} min` : `${Math.floor(s / 3600)}:${two(Math.floor(s / 60) % 60)} h`;
}
