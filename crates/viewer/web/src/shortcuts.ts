// Keyboard shortcuts: one list that defines both the actions and the help overlay.

import { element, make, onClick } from "./dom";

export interface Shortcut {
  /** As in `KeyboardEvent.key`, lower case; several for a row that is only shown. */
  keys: string[];
  label: string;
  /** Empty: active but not shown in the help. */
  group: string;
  /** Absent: shown in the help, handled elsewhere. */
  act?: () => void;
}

const NAMES: Record<string, string> = { " ": "Space", escape: "Esc", arrowleft: "←", arrowright: "→" };

export class Shortcuts {
  private readonly dialog = element<HTMLDialogElement>("help");

  constructor(private readonly list: Shortcut[]) {
    onClick("help-open", () => this.toggleHelp());
    onClick("help-close", () => this.dialog.close());
    // A click outside the overlay closes it.
    this.dialog.addEventListener("click", (e) => e.target === this.dialog && this.dialog.close());
    this.fill();
    window.addEventListener("keydown", (e) => this.press(e));
  }

  toggleHelp(): void {
    if (this.dialog.open) this.dialog.close();
    else this.dialog.showModal();
  }

  private press(e: KeyboardEvent): void {
    if (e.ctrlKey || e.metaKey || e.altKey || e.repeat || writes(e.target)) return;
    const key = e.key.toLowerCase();
    if (key === "?") {
      e.preventDefault();
      this.toggleHelp();
      return;
    }
    if (this.dialog.open) return;
    // A focused button uses Space itself.
    if (key === " " && e.target instanceof HTMLElement && e.target.closest("button, summary, a")) return;
    // Arrow keys move a slider or the choice of a layer.
    if (key.startsWith("arrow") && e.target instanceof HTMLElement && e.target.matches("input, [role=radio]")) return;
    const found = this.list.find((s) => s.act && s.keys.includes(key));
    if (!found) return;
    e.preventDefault();
    found.act?.();
  }

  private fill(): void {
    const groups = new Map<string, Shortcut[]>();
    for (const s of this.list.filter((s) => s.group)) groups.set(s.group, [...(groups.get(s.group) ?? []), s]);
    const tables = [...groups].map(([name, rows]) => {
      const lines = rows.map((s) => {
        const keys = s.keys.map((k) => make("kbd", { textContent: NAMES[k] ?? (k.length === 1 ? k.toUpperCase() : k) }));
        return make("div", {}, make("dt", {}, ...keys), make("dd", { textContent: s.label }));
      });
      return make("section", {}, make("h3", { textContent: name }), make("dl", {}, ...lines));
    });
    element("help-list").replaceChildren(...tables);
  }
}

/** Whether keys enter text or a value in this element. */
export function writes(target: EventTarget | null): boolean {
  if (target instanceof HTMLInputElement) return target.type !== "checkbox" && target.type !== "radio" && target.type !== "range";
  return target instanceof HTMLSelectElement || target instanceof HTMLTextAreaElement;
}
