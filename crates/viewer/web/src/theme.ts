// Dark and light theme: the system's setting until the user chooses.

import { element, memory, onClick } from "./dom";

const CHOICES = ["system", "light", "dark"] as const;
type Choice = (typeof CHOICES)[number];

export class Theme {
  private choice: Choice;

  constructor() {
    const kept = memory.get("theme");
    this.choice = CHOICES.find((c) => c === kept) ?? "system";
    onClick("theme", () => this.next());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.show());
    this.show();
  }

  /** Cycles through system, light and dark. */
  next(): void {
    this.choice = CHOICES[(CHOICES.indexOf(this.choice) + 1) % CHOICES.length] ?? "system";
    memory.set("theme", this.choice);
    this.show();
  }

  private show(): void {
    document.documentElement.dataset.theme = this.choice;
    const b = element("theme");
    b.querySelector("use")?.setAttribute("href", `#i-${{ system: "contrast", light: "sun", dark: "moon" }[this.choice]}`);
    const label = { system: "Theme: system", light: "Theme: light", dark: "Theme: dark" }[this.choice];
    b.title = `${label} (T)`;
    b.setAttribute("aria-label", label);
  }
}
