// Progress of training: figures, a bar, and small charts. The program chooses figures and charts.

import type { Connection, Received } from "./connection";
import { element, make, svg } from "./dom";
import type { Chart, Figure, Line } from "./messages";

/** Most points of a line; when there are more, every second one is dropped. */
const MOST = 400;
const [WIDTH, HEIGHT] = [272, 64];

export class Training {
  private charts: Chart[] = [];

  /** `running` is called with whether training is running. */
  constructor(connection: Connection, private readonly running: (on: boolean) => void) {
    connection.on("status", (t) => this.show(t));
    connection.on("history", (t) => {
      this.charts = t.charts;
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
    const rows: [string, string, string][] = [["step", "Step", group(t.step)]];
    for (const f of t.figures) rows.push([f.id, f.label, grouped(f.text)]);
    if (t.seconds > 0) rows.push(["seconds", "Time", duration(t.seconds)]);
    element("training-figures").replaceChildren(...rows.map(([id, label, text]) => {
      const value = make("dd", { textContent: text });
      value.dataset.figure = id;
      return make("div", {}, make("dt", { textContent: label, title: label }), value);
    }));
    element("training-state").textContent = t.running ? `${Math.round(100 * t.progress)} %` : "finished";
    element("training-progress").hidden = !t.running;
    element("training-bar").style.width = `${100 * t.progress}%`;
    if (t.running) this.add(t.step, t.figures);
  }

  private add(step: number, figures: Figure[]): void {
    const lines = this.charts.flatMap((c) => c.lines);
    // Another run starts with empty lines.
    if (lines.some((l) => (l.points.at(-1)?.[0] ?? 0) > step)) lines.forEach((l) => (l.points = []));
    let grew = false;
    for (const l of lines) {
      const value = figures.find((f) => f.id === l.figure)?.value;
      const last = l.points.at(-1);
      // What is the same as before was not measured again.
      if (value === undefined || value === last?.[1] || step === last?.[0]) continue;
      l.points.push([step, value]);
      if (l.points.length > MOST) l.points = l.points.filter((_, i) => i % 2 === 0 || i === l.points.length - 1);
      grew = true;
    }
    if (grew) this.draw();
  }

  private draw(): void {
    element("charts").replaceChildren(...this.charts.filter((c) => c.lines.some((l) => l.points.length > 1)).map(chart));
  }
}

/** A chart with what its lines are called and from where to where they go. */
function chart(c: Chart): HTMLElement {
  const points = c.lines.flatMap((l) => l.points);
  const [steps, values] = [points.map((p) => p[0]), points.map((p) => p[1])];
  const [first, low, high] = [Math.min(...steps), Math.min(...values), Math.max(...values)];
  const x = (step: number) => 5 + ((WIDTH - 10) * (step - first)) / Math.max(1, Math.max(...steps) - first);
  const y = (v: number) => HEIGHT - 6 - ((HEIGHT - 12) * (v - low)) / (high - low || 1);
  const drawn = (l: Line) => {
    const at = l.points.map(([step, v]) => [x(step).toFixed(1), y(v).toFixed(1)] as const);
    const dots = l.held_out ? at.map(([cx, cy]) => svg("circle", { cx, cy, r: 2.4 })) : [];
    const points = at.map((p) => p.join()).join(" ");
    return [svg("polyline", { class: l.held_out ? "held-out" : "", "data-figure": l.figure, points }), ...dots];
  };
  const picture = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `${c.label} over the steps` });
  picture.append(...c.lines.flatMap(drawn));
  const keys = c.lines.filter((l) => l.points.length > 0).map((l) => make("span", { className: l.held_out ? "key held-out" : "key", textContent: l.label }));
  const range = make("span", { textContent: `${short(low)} – ${short(high)}${c.unit && ` ${c.unit}`}` });
  return make("figure", { className: "chart" }, picture, make("figcaption", {}, make("b", { textContent: c.label }), ...keys, range));
}

const short = (v: number) => (Math.abs(v) >= 10 ? v.toFixed(1) : v.toPrecision(2));

const group = (n: number) => grouped(String(n));

/** Thin spaces between groups of three digits of a whole number. */
const grouped = (text: string) => text.replace(/^\d{4,}(?![\d.])/, (n) => n.replace(/\B(?=(\d{3})+$)/g, "\u202f"));

function duration(seconds: number): string {
  const s = Math.round(seconds);
  const two = (n: number) => String(n).padStart(2, "0");
  return s < 3600 ? `${Math.floor(s / 60)}:${two(s % 60)} min` : `${Math.floor(s / 3600)}:${two(Math.floor(s / 60) % 60)} h`;
}
