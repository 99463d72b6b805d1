// The controls that the program lists: sliders, switches and picks, with their values.

import type { Control, Value } from "./messages";
import { element, iconButton, make } from "./dom";

type Slider = Extract<Control["input"], { kind: "slider" }>;
type Pick = Extract<Control["input"], { kind: "pick" }>;

export class ControlList {
  private controls: Control[] = [];
  private readonly given = new Map<string, Value>();

  /** `changed` is called when a value changes. */
  constructor(private readonly changed: () => void) {}

  /** Values that are not the defaults. */
  get values(): Record<string, Value> {
    return Object.fromEntries(this.given);
  }

  /** Sets the program's list; values of controls that still exist stay. */
  set(controls: Control[]): void {
    this.controls = controls;
    for (const id of [...this.given.keys()]) if (!controls.some((c) => c.id === id)) this.given.delete(id);
    element("controls").replaceChildren(...controls.map((c) => this.row(c)));
  }

  /** Shows the controls that change a layer. */
  showFor(layer: string): void {
    let shown = 0;
    for (const row of element("controls").querySelectorAll<HTMLElement>("[data-control]")) {
      const c = this.controls.find((c) => c.id === row.dataset.control);
      row.hidden = !c || (c.layers.length > 0 && !c.layers.includes(layer));
      if (!row.hidden) shown += 1;
    }
    element("controls").hidden = shown === 0;
  }

  private row(c: Control): HTMLElement {
    const row = make("div", { className: "control", title: c.help });
    row.dataset.control = c.id;
    const reset = iconButton("reset", `Reset ${c.label}`, () => {
      this.given.delete(c.id);
      const fresh = this.row(c);
      row.replaceWith(fresh);
      fresh.querySelector<HTMLElement>("input, select")?.focus();
      this.changed();
    });
    reset.classList.add("reset");
    const take = (value: Value) => {
      if (value === c.input.default) this.given.delete(c.id);
      else this.given.set(c.id, value);
      reset.classList.toggle("away", !this.given.has(c.id));
      this.changed();
    };
    reset.classList.toggle("away", !this.given.has(c.id));
    const now = this.given.get(c.id) ?? c.input.default;
    if (c.input.kind === "slider") row.append(...slider(c, c.input, Number(now), take), reset);
    else if (c.input.kind === "pick") row.append(...pick(c, c.input, String(now), take), reset);
    else row.append(toggle(c, now === true, take), reset);
    return row;
  }
}

function slider(c: Control, s: Slider, now: number, take: (v: Value) => void): HTMLElement[] {
  const id = `control-${c.id}`;
  const digits = Math.max(0, Math.ceil(-Math.log10(s.step) - 1e-9));
  const text = (v: number) => `${v.toFixed(digits)}${s.unit.length > 1 ? " " : ""}${s.unit}`;
  const range = make("input", { type: "range", id, min: String(s.min), max: String(s.max), step: String(s.step) });
  range.value = String(now);
  const out = make("output", { textContent: text(now) });
  range.addEventListener("input", () => {
    out.textContent = text(Number(range.value));
    take(Number(range.value));
  });
  return [make("label", { htmlFor: id, textContent: c.label }), range, out];
}

function pick(c: Control, p: Pick, now: string, take: (v: Value) => void): HTMLElement[] {
  const id = `control-${c.id}`;
  const list = make("select", { id }, ...p.options.map((o) => make("option", { value: o.id, textContent: o.label })));
  list.value = now;
  list.addEventListener("change", () => take(list.value));
  return [make("label", { htmlFor: id, textContent: c.label }), list];
}

function toggle(c: Control, now: boolean, take: (v: Value) => void): HTMLElement {
  const box = make("input", { type: "checkbox", id: `control-${c.id}`, checked: now, className: "switch" });
  box.addEventListener("change", () => take(box.checked));
  return make("label", { className: "toggle" }, box, c.label);
}
