// Notices: short messages, the banner for a lost connection, and the message shown when there is no picture.

import type { Connection, ConnectionState } from "./connection";
import { element, icon, make, onClick } from "./dom";

export type Level = "info" | "good" | "error";

const ICONS: Record<Level, string> = { info: "info", good: "check", error: "warn" };
/** Milliseconds for which a notice is shown. */
const STAY = { info: 4000, good: 4000, error: 9000 };

export class Notices {
  private lostOnce = false;
  private everOpen = false;
  private countdown = 0;

  constructor(connection: Connection) {
    onClick("retry", () => connection.connect());
    connection.onState((s) => this.showState(s));
  }

  /** Shows a line for some seconds; repeating the same line only restarts the time. */
  say(text: string, level: Level = "info"): void {
    const place = element("toasts");
    for (const old of place.querySelectorAll<HTMLElement>(".toast")) if (old.dataset.text === text) old.remove();
    const close = make("button", { className: "quiet", type: "button", title: "Dismiss" }, icon("close"));
    close.setAttribute("aria-label", "Dismiss");
    const toast = make("div", { className: `toast ${level}` }, icon(ICONS[level]), make("span", { textContent: text }), close);
    toast.dataset.text = text;
    close.addEventListener("click", () => toast.remove());
    place.append(toast);
    while (place.children.length > 3) place.firstElementChild?.remove();
    setTimeout(() => toast.remove(), STAY[level]);
  }

  /** Shows why there is no picture; null: there is one. */
  showEmpty(title: string | null, detail = "", busy = false): void {
    const place = element("empty");
    place.hidden = title === null;
    place.classList.toggle("busy", busy);
    element("empty-title").textContent = title ?? "";
    element("empty-detail").textContent = detail;
  }

  private showState(state: ConnectionState): void {
    clearInterval(this.countdown);
    document.body.dataset.connection = state.kind;
    if (state.kind === "open") {
      element("banner").hidden = true;
      if (this.lostOnce && this.everOpen) this.say("Connected again", "good");
      if (!this.everOpen) this.showEmpty("Loading the scene", "", true);
      this.lostOnce = false;
      this.everOpen = true;
    } else if (state.kind === "lost") {
      this.lostOnce = true;
      if (!this.everOpen) this.showEmpty("No connection", "Is diorama still running? Open the address that it printed, including its token.");
      element("banner").hidden = false;
      const tick = () => {
        const left = Math.max(0, Math.ceil((state.retryAt - Date.now()) / 1000));
        element("banner-text").textContent = `The program has ended or does not respond. Retrying in ${left} s.`;
      };
      tick();
      this.countdown = window.setInterval(tick, 500);
    } else if (this.lostOnce) {
      element("banner-text").textContent = "The program has ended or does not respond. Retrying…";
    } else {
      this.showEmpty("Connecting", "", true);
    }
  }
}
