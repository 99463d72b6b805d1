// The camera path: a list of views that can be played, saved in the run, opened and downloaded.

import * as THREE from "three";
import type { Connection } from "./connection";
import type { Navigation } from "./navigation";
import type { Notices } from "./notices";
import { type Key, type PathSettings, at, fromJson, seconds, toJson } from "./path";
import { Stage } from "./stage";
import { download, element, iconButton, input, make, onClick } from "./dom";

export class PathEditor {
  private keys: Key[] = [];
  private begun: number | null = null;
  private wantsDownload = false;

  constructor(
    private readonly connection: Connection,
    private readonly stage: Stage,
    private readonly navigation: Navigation,
    private readonly notices: Notices,
  ) {
    onClick("key-add", () => this.add());
    onClick("key-play", () => this.togglePlay());
    onClick("key-clear", () => {
      this.keys = [];
      this.show();
    });
    onClick("path-save", () => this.save());
    // Saved first, because the program writes the file with cameras in the capture's frame.
    onClick("path-download", () => (this.wantsDownload = this.save()));
    onClick("path-open-button", () => input("path-open").click());
    input("path-open").addEventListener("change", async () => {
      const file = input("path-open").files?.[0];
      if (file) connection.send({ kind: "open_path", json: await file.text() });
      input("path-open").value = "";
    });
    input("key-cycle").addEventListener("change", () => this.show());
    input("key-seconds").addEventListener("input", () => this.show());
    connection.on("path", (t) => this.open(t.json));
    connection.on("saved", (t) => {
      if (t.what !== "camera path" || !this.wantsDownload) return;
      this.wantsDownload = false;
      download("camera_path.json", `camera_path.json${connection.query}`);
    });
    element("overlay").addEventListener("pointerdown", () => this.stop());
    this.show();
  }

  add(): void {
    this.keys.push(this.navigation.key);
    this.show();
  }

  togglePlay(): void {
    if (this.begun !== null) return this.stop();
    if (this.keys.length < 2) return this.notices.say("A path needs two views: add another", "error");
    this.begun = performance.now();
    this.showPlaying(0);
  }

  stop(): void {
    if (this.begun === null) return;
    this.begun = null;
    this.showPlaying(0);
  }

  /** Moves the camera along the path while it plays. */
  tick(now: number): void {
    if (this.begun === null) return;
    const s = this.settings;
    const t = (now - this.begun) / 1000 / seconds(this.keys, s);
    this.navigation.standAt(at(this.keys, t, s.cycle));
    if (t >= 1) this.stop();
    else this.showPlaying(t);
  }

  open(json: string): void {
    try {
      const { keys, settings } = fromJson(json);
      this.keys = keys;
      input("key-seconds").value = String(Number(settings.secondsPerView.toFixed(2)));
      input("key-fps").value = String(settings.fps);
      input("key-width").value = String(settings.width);
      input("key-height").value = String(settings.height);
      input("key-cycle").checked = settings.cycle;
      this.show();
    } catch (e) {
      this.notices.say(`The camera path could not be read: ${e}`, "error");
    }
  }

  private get settings(): PathSettings {
    const number = (id: string) => Number(input(id).value);
    return {
      secondsPerView: number("key-seconds") || 2,
      fps: number("key-fps") || 24,
      width: Math.round(number("key-width")) || 1280,
      height: Math.round(number("key-height")) || 720,
      cycle: input("key-cycle").checked,
    };
  }

  private save(): boolean {
    if (this.keys.length === 0) {
      this.notices.say("Add a view first", "error");
      return false;
    }
    return this.connection.send({ kind: "path", json: toJson(this.keys, this.settings) });
  }

  private show(): void {
    this.stop();
    element("keys").replaceChildren(...this.keys.map((k, i) => this.row(k, i)));
    const s = this.settings;
    const enough = this.keys.length > 1;
    element("keys-empty").hidden = this.keys.length > 0;
    element("path-length").textContent = enough ? `${seconds(this.keys, s).toFixed(1)} s` : "";
    for (const id of ["key-clear", "path-save", "path-download"]) element<HTMLButtonElement>(id).disabled = this.keys.length === 0;
    element<HTMLButtonElement>("key-play").disabled = !enough;
    const n = 100;
    const places = enough ? Array.from({ length: n + 1 }, (_, i) => at(this.keys, i / n, s.cycle)) : [];
    this.stage.showPath(places.map((p) => new THREE.Vector3().setFromMatrixPosition(p.matrix)));
  }

  private row(k: Key, i: number): HTMLElement {
    const go = make("button", { className: "quiet grow", type: "button", title: "Look from here" }, `View ${i + 1}`);
    go.append(make("small", { textContent: `${Math.round(k.fov)}°` }));
    go.addEventListener("click", () => this.navigation.goTo(k));
    const renew = iconButton("target", `Set view ${i + 1} to the current camera`, () => {
      this.keys[i] = this.navigation.key;
      this.show();
    });
    const drop = iconButton("trash", `Remove view ${i + 1}`, () => {
      this.keys.splice(i, 1);
      this.show();
    });
    return make("li", {}, go, renew, drop);
  }

  private showPlaying(t: number): void {
    const on = this.begun !== null;
    const b = element("key-play");
    b.querySelector("use")?.setAttribute("href", on ? "#i-stop" : "#i-play");
    element("key-play-label").textContent = on ? "Stop" : "Play";
    element("path-progress").style.width = `${100 * t}%`;
  }
}
