// The photographs: a strip of thumbnails; a click moves the camera to the pose of a photograph.

import type { Photograph } from "./messages";
import type { Connection } from "./connection";
import { THUMBNAIL } from "./views";
import { element, make } from "./dom";

/** Most thumbnails in the strip; with more photographs, every second or third is shown. */
const MOST = 200;

export class Frames {
  private photographs: Photograph[] = [];
  private foggy = new Set<number>();
  private current = -1;
  /** Whether the camera has left the current photograph. */
  private away = false;
  private sight: IntersectionObserver | null = null;

  constructor(private readonly connection: Connection, private readonly lookFrom: (p: Photograph) => void) {
    connection.onPicture((id, blob) => {
      const img = id >= THUMBNAIL && element("photographs").querySelector<HTMLImageElement>(`img[data-frame="${id - THUMBNAIL}"]`);
      if (!img) return;
      img.addEventListener("load", () => URL.revokeObjectURL(img.src), { once: true });
      img.src = URL.createObjectURL(blob);
    });
    // A mouse wheel without a horizontal axis scrolls the strip sideways.
    element("photographs").addEventListener("wheel", (e) => {
      if (e.deltaX === 0 && element("photographs").scrollWidth > element("photographs").clientWidth) {
        e.preventDefault();
        element("photographs").scrollLeft += e.deltaY;
      }
    }, { passive: false });
    connection.on("fog", (t) => {
      this.foggy = new Set(t.frames);
      this.mark();
    });
  }

  /** Sets a scene's photographs; `home`: the camera is at the first one's pose. */
  set(photographs: Photograph[], home: boolean): void {
    this.photographs = photographs;
    if (home || this.current >= photographs.length) this.current = photographs.length > 0 ? 0 : -1;
    this.away = !home;
    const some = Math.ceil(photographs.length / MOST);
    const place = element("photographs");
    place.replaceChildren(...photographs.flatMap((p, i) => {
      if (i % some !== 0) return [];
      const img = make("img", { alt: p.name });
      const b = make("button", { type: "button" }, img);
      b.dataset.frame = img.dataset.frame = String(i);
      b.classList.toggle("held-out", p.held_out);
      b.addEventListener("click", () => this.choose(i));
      return [b];
    }));
    const held = photographs.filter((p) => p.held_out).length;
    element("photo-count").textContent = photographs.length === 0 ? "" : `${photographs.length}${held ? `, ${held} held out` : ""}`;
    element("photos-empty").hidden = photographs.length > 0;
    element("held-out-key").hidden = held === 0;
    this.mark();
    this.fetchInSight(place);
  }

  /** Moves to the next photograph, or with -1 to the previous one. */
  step(by: number): void {
    const n = this.photographs.length;
    if (n > 0) this.choose((this.current + by + n) % n);
  }

  /** Removes the mark after the camera has left the photograph. */
  leave(): void {
    if (this.away) return;
    this.away = true;
    this.mark();
  }

  private choose(i: number): void {
    const p = this.photographs[i];
    if (!p) return;
    [this.current, this.away] = [i, false];
    this.mark();
    element("photographs").querySelector(`[data-frame="${i}"]`)?.scrollIntoView({ block: "nearest", inline: "nearest" });
    this.lookFrom(p);
  }

  /** Marks the chosen photograph, and those whose views are behind fog. */
  private mark(): void {
    for (const b of element("photographs").querySelectorAll<HTMLElement>("button")) {
      const frame = Number(b.dataset.frame);
      const p = this.photographs[frame];
      b.classList.toggle("fog", this.foggy.has(frame));
      b.setAttribute("aria-pressed", String(frame === this.current && !this.away));
      b.title = (p?.name ?? "") + (p?.held_out ? " (held out)" : "") + (this.foggy.has(frame) ? " (behind fog)" : "");
    }
    element("fog-key").hidden = this.foggy.size === 0;
    document.body.dataset.fog = String(this.foggy.size);
  }

  /** Requests thumbnails when they scroll into view. */
  private fetchInSight(place: HTMLElement): void {
    this.sight?.disconnect();
    const sight = new IntersectionObserver((entries) => {
      for (const e of entries.filter((e) => e.isIntersecting)) {
        const frame = Number((e.target as HTMLElement).dataset.frame);
        if (this.connection.send({ kind: "thumbnail", frame })) sight.unobserve(e.target);
      }
    });
    place.querySelectorAll("img").forEach((i) => sight.observe(i));
    this.sight = sight;
  }
}
