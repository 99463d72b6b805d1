// The layers that the program lists: buttons to choose one, and its legend.

import type { Layer } from "./messages";
import { element, make } from "./dom";

export class LayerList {
  private layers: Layer[] = [];
  private chosen = "";

  /** `changed` is called when another layer is chosen. */
  constructor(private readonly changed: () => void) {
    element("layers").addEventListener("keydown", (e) => {
      const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[e.key];
      if (!by) return;
      e.preventDefault();
      const n = this.layers.length;
      this.chooseNumber((this.layers.findIndex((l) => l.id === this.chosen) + by + n) % n);
      element("layers").querySelector<HTMLElement>("[aria-checked=true]")?.focus();
    });
  }

  /** Id of the chosen layer. */
  get id(): string {
    return this.chosen;
  }

  /** Sets the program's list; the chosen layer stays if it still exists. */
  set(layers: Layer[]): void {
    this.layers = layers;
    if (!layers.some((l) => l.id === this.chosen)) this.chosen = layers[0]?.id ?? "";
    element("layers").replaceChildren(...layers.map((l, i) => {
      const b = make("button", { type: "button", textContent: l.label, title: i < 9 ? `${l.label} (${i + 1})` : l.label });
      b.dataset.layer = l.id;
      b.setAttribute("role", "radio");
      b.addEventListener("click", () => this.choose(l.id));
      return b;
    }));
    this.show();
  }

  choose(id: string): void {
    if (id === this.chosen) return;
    this.chosen = id;
    this.show();
    this.changed();
  }

  /** Chooses the layer with an index of the list, if it exists. */
  chooseNumber(i: number): void {
    const layer = this.layers[i];
    if (layer) this.choose(layer.id);
  }

  private show(): void {
    for (const b of element("layers").querySelectorAll<HTMLElement>("button")) {
      const on = b.dataset.layer === this.chosen;
      b.setAttribute("aria-checked", String(on));
      b.tabIndex = on ? 0 : -1;
    }
    const layer = this.layers.find((l) => l.id === this.chosen);
    document.body.dataset.layer = this.chosen;
    const place = element("legend");
    place.hidden = !layer?.legend;
    if (layer?.legend) place.replaceChildren(make("strong", { textContent: layer.label }), ...legend(layer.legend));
  }
}

function legend(l: NonNullable<Layer["legend"]>): HTMLElement[] {
  if (l.kind === "classes") {
    return l.classes.map((c) => make("span", { className: "class" }, swatch(c.color), c.label));
  }
  const ramp = make("span", { className: "ramp" });
  ramp.style.background = `linear-gradient(to right, ${l.colors.join(", ")})`;
  const unit = l.unit ? ` ${l.unit}` : "";
  return [make("span", { textContent: l.low + unit }), ramp, make("span", { textContent: l.high + unit })];
}

function swatch(color: string): HTMLElement {
  const s = make("i", { className: "swatch" });
  s.style.background = color;
  return s;
}
