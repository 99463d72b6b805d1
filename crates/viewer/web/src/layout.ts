// Panels: cards that fold, a dock that can be hidden, and on small screens a sheet with tabs that can be dragged up and down.

import { element, memory, onClick } from "./dom";

const PHONE = "(max-width: 720px)";
/** Share of the window covered by an open sheet, and by a fully extended one. */
const [HALF, WHOLE] = [0.5, 0.85];
/** Pixels that a finger may move during a tap. */
const TAP = 6;

export class Layout {
  private readonly phone = matchMedia(PHONE);
  private readonly cards = [...document.querySelectorAll<HTMLDetailsElement>("details.card")];
  private tab = "view";
  /** Height of the sheet's body in pixels. */
  private height = 0;
  private open: Set<string>;

  /** `changed` is called when the size of the stage changes. */
  constructor(private readonly changed: () => void) {
    this.open = new Set((memory.get("cards") ?? "training view").split(" "));
    for (const c of this.cards) {
      c.addEventListener("toggle", () => {
        if (this.phone.matches) return;
        if (c.open) this.open.add(name(c));
        else this.open.delete(name(c));
        memory.set("cards", [...this.open].join(" "));
      });
    }
    for (const t of element("tabs").querySelectorAll<HTMLElement>("button")) {
      t.addEventListener("click", () => this.choose(t.dataset.tab ?? "view"));
    }
    onClick("panels", () => this.togglePanels());
    onClick("strip-fold", () => this.toggleStrip());
    this.phone.addEventListener("change", () => this.arrange());
    window.addEventListener("resize", () => this.arrange());
    this.drag();
    document.body.classList.toggle("no-strip", memory.get("strip") === "hidden");
    document.body.classList.toggle("no-panels", memory.get("panels") === "hidden");
    this.arrange();
  }

  /** Opens a card, and on a small screen its tab. */
  show(card: string): void {
    if (this.phone.matches) {
      this.tab = card;
      if (this.height < 40) this.height = innerHeight * HALF;
      return this.arrange();
    }
    document.body.classList.remove("no-panels");
    const found = this.cards.find((c) => name(c) === card);
    if (found) found.open = true;
    found?.scrollIntoView({ block: "nearest" });
  }

  togglePanels(): void {
    if (this.phone.matches) {
      this.height = this.height > 40 ? 0 : innerHeight * HALF;
      return this.arrange();
    }
    const hidden = document.body.classList.toggle("no-panels");
    memory.set("panels", hidden ? "hidden" : "shown");
    this.arrange();
  }

  toggleStrip(): void {
    if (this.phone.matches) return this.choose("photos");
    const hidden = document.body.classList.toggle("no-strip");
    memory.set("strip", hidden ? "hidden" : "shown");
    this.arrange();
  }

  /** Chooses a tab; choosing the current one again folds the sheet. */
  private choose(tab: string): void {
    if (this.tab === tab && this.height > 40) this.height = 0;
    else if (this.height < 40) this.height = innerHeight * HALF;
    this.tab = tab;
    this.arrange();
  }

  private arrange(): void {
    const phone = this.phone.matches;
    const shown = phone ? Math.min(this.height, innerHeight * WHOLE) : 0;
    document.body.style.setProperty("--sheet", `${Math.round(shown)}px`);
    document.body.classList.toggle("sheet-open", shown > 40);
    for (const c of this.cards) {
      c.open = phone || this.open.has(name(c));
      c.classList.toggle("chosen", name(c) === this.tab);
    }
    element("photos").classList.toggle("chosen", this.tab === "photos");
    for (const t of element("tabs").querySelectorAll<HTMLElement>("button")) {
      t.setAttribute("aria-pressed", String(shown > 40 && t.dataset.tab === this.tab));
    }
    const hidden = document.body.classList.contains("no-panels");
    element("panels").setAttribute("aria-pressed", String(!hidden));
    element("strip-fold").setAttribute("aria-expanded", String(!document.body.classList.contains("no-strip")));
    this.changed();
  }

  /** The grip drags the sheet up and down; a tap opens or folds it. */
  private drag(): void {
    const grip = element("grip");
    let from: { y: number; height: number } | null = null;
    grip.addEventListener("pointerdown", (e) => {
      from = { y: e.clientY, height: this.height };
      grip.setPointerCapture(e.pointerId);
      document.body.classList.add("dragging");
    });
    grip.addEventListener("pointermove", (e) => {
      if (!from) return;
      const wanted = Math.min(innerHeight * WHOLE, Math.max(0, from.height + from.y - e.clientY));
      document.body.style.setProperty("--sheet", `${Math.round(wanted)}px`);
    });
    const end = (e: PointerEvent) => {
      if (!from) return;
      const by = from.y - e.clientY;
      document.body.classList.remove("dragging");
      if (Math.abs(by) < TAP) this.height = this.height > 40 ? 0 : innerHeight * HALF;
      else {
        const wanted = from.height + by;
        const stops = [0, innerHeight * HALF, innerHeight * WHOLE];
        this.height = stops.reduce((a, b) => (Math.abs(b - wanted) < Math.abs(a - wanted) ? b : a));
      }
      from = null;
      this.arrange();
    };
    grip.addEventListener("pointerup", end);
    grip.addEventListener("pointercancel", end);
    grip.addEventListener("keydown", (e) => {
      if (e.key === "Enter" || e.key === " ") this.togglePanels();
    });
  }
}

const name = (card: HTMLElement) => card.id.replace("card-", "");
