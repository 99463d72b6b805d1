// The picture: requests views as fast as they arrive, at lower resolution while the camera moves, and draws them.

import type { View } from "./messages";
import type { Connection } from "./connection";
import { element } from "./dom";

/** Target time of a view in milliseconds while the camera moves. */
const TARGET = 50;
/** Milliseconds without motion after which a view is requested at full resolution. */
const REST = 180;
/** Milliseconds between views of a field in training. */
const REFRESH = 2000;
/** Ids from here on are thumbnails. */
export const THUMBNAIL = 2 ** 31;

interface Asked {
  id: number;
  when: number;
  scale: number;
}

export class Views {
  readonly canvas = element<HTMLCanvasElement>("picture");
  /** Whether the field is being trained. */
  training = false;
  private nextId = 0;
  private asked: Asked | null = null;
  private scale = 0.3;
  private shown = 0;
  private dirty = false;
  private moved = 0;
  private refreshed = 0;
  private took = 0;
  private failed = false;
  private count = 0;

  /** `describe` returns the view at a given size; `drawn` is called after each view, with null or the reason of its failure. */
  constructor(
    private readonly connection: Connection,
    private readonly describe: (width: number, height: number) => View,
    private readonly drawn: (why: string | null) => void,
  ) {
    connection.onPicture((id, blob) => {
      if (id < THUMBNAIL) void this.see(id, blob);
    });
    connection.onState((s) => {
      if (s.kind !== "open") this.asked = null;
    });
    connection.on("failed", (t) => {
      if (t.view === null) return;
      if (this.asked?.id === t.view) this.asked = null;
      // The same view would fail again; it is requested when something changes.
      this.failed = true;
      this.shown = 1;
      this.drawn(t.why);
    });
  }

  /** Marks the displayed view as outdated. */
  touch(): void {
    this.dirty = true;
    this.failed = false;
    this.moved = performance.now();
  }

  /** Requests a view if one is needed. */
  tick(now: number): void {
    document.body.dataset.settled = String(!this.dirty && !this.asked && this.shown === 1);
    if (this.asked || !this.connection.isOpen) return;
    const rest = now - this.moved;
    if (this.dirty) this.ask(Math.min(this.scale, 0.999));
    else if (rest > REST && this.shown < 1) this.ask(this.shown < 0.5 ? 0.5 : 1);
    else if (this.training && !this.failed && rest > REFRESH && now - this.refreshed > REFRESH) {
      this.refreshed = now;
      this.ask(0.5);
    }
  }

  private ask(scale: number): void {
    // Panels lie over the stage: the picture fills the window.
    const width = Math.max(16, Math.round(this.canvas.clientWidth * scale));
    const height = Math.max(16, Math.round(this.canvas.clientHeight * scale));
    this.asked = { id: this.nextId++ % THUMBNAIL, when: performance.now(), scale };
    this.dirty = false;
    if (!this.connection.send({ kind: "view", id: this.asked.id, view: this.describe(width, height) })) this.asked = null;
  }

  private async see(id: number, blob: Blob): Promise<void> {
    const bitmap = await createImageBitmap(blob);
    const { width, height } = bitmap;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
    bitmap.close();
    this.count += 1;
    this.drawn(null);
    if (this.asked?.id === id) {
      this.measure(this.asked);
      this.asked = null;
    }
    const kept = document.body.dataset;
    [kept.views, kept.took, kept.scale] = [String(this.count), this.took.toFixed(1), this.shown.toFixed(3)];
    element("figures").textContent = `${width} × ${height} · ${Math.round(this.took)} ms`;
  }

  /** Chooses the scale of the next views from the time that this one took. */
  private measure(asked: Asked): void {
    this.took = performance.now() - asked.when;
    this.shown = asked.scale;
    if (asked.scale >= 1) return;
    // The time is proportional to the number of pixels, the square of the scale.
    const wanted = asked.scale * Math.sqrt(TARGET / Math.max(this.took, 1));
    this.scale = Math.min(1, Math.max(0.1, 0.6 * this.scale + 0.4 * wanted));
  }
}
