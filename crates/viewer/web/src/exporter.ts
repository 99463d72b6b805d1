// Meshes: export, progress, display over the picture, download; and screenshots.

import type { Connection } from "./connection";
import type { Notices } from "./notices";
import { type Box6, Stage } from "./stage";
import { download, element, input, onClick, select } from "./dom";

export class Exporter {
  private worldFromCapture: number[] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];
  private making = false;

  constructor(
    private readonly connection: Connection,
    private readonly stage: Stage,
    private readonly notices: Notices,
    private readonly clip: () => Box6 | null,
  ) {
    onClick("export", () => this.begin());
    onClick("screenshot", () => this.screenshot());
    input("mesh").addEventListener("change", () => stage.showMesh(input("mesh").checked));
    connection.on("working", (t) => this.show(t.what, t.percent));
    connection.on("exported", (t) => {
      this.show(null);
      notices.say(`Exported ${t.file}`, "good");
      if (t.glb) void this.load(t.scale);
    });
    connection.on("failed", (t) => t.view === null && this.show(null));
    connection.onState((s) => s.kind !== "open" && this.show(null));
  }

  set(worldFromCapture: number[]): void {
    this.worldFromCapture = worldFromCapture;
  }

  toggleMesh(): void {
    if (input("mesh").disabled) return this.notices.say("There is no mesh yet: export a GLB", "error");
    input("mesh").checked = !input("mesh").checked;
    this.stage.showMesh(input("mesh").checked);
  }

  /** Saves the picture with its overlay as PNG. */
  screenshot(): void {
    const picture = element<HTMLCanvasElement>("picture");
    const both = document.createElement("canvas");
    [both.width, both.height] = [picture.width, picture.height];
    const g = both.getContext("2d");
    g?.drawImage(picture, 0, 0);
    if (this.stage.hasSomething) g?.drawImage(element<HTMLCanvasElement>("overlay"), 0, 0, both.width, both.height);
    download("diorama.png", both.toDataURL("image/png"));
    this.notices.say("Screenshot saved as diorama.png", "good");
  }

  private begin(): void {
    const whole = (id: string) => Math.max(1, Math.round(Number(input(id).value)) || 1);
    if (this.making) return;
    const ask = { kind: "export", format: select("format").value, faces: whole("faces"), resolution: whole("resolution"), clip: this.clip() } as const;
    if (this.connection.send(ask)) this.show("Starting", 0);
  }

  /** Shows the progress of an export; null: no export is running. */
  private show(what: string | null, percent = 0): void {
    this.making = what !== null;
    element<HTMLButtonElement>("export").disabled = this.making;
    element("export-progress").hidden = !this.making;
    element("export-bar").style.width = `${percent}%`;
    element("export-what").textContent = what === null ? "" : `${what}: ${percent} %`;
  }

  private async load(scale: number): Promise<void> {
    const url = `mesh.glb${this.connection.query}`;
    element<HTMLAnchorElement>("mesh-link").href = url;
    element("mesh-link").hidden = false;
    try {
      await this.stage.loadMesh(url, this.worldFromCapture, scale);
      input("mesh").disabled = false;
      input("mesh").checked = true;
      element("mesh-note").hidden = true;
      this.stage.showMesh(true);
      document.body.dataset.mesh = "shown";
    } catch (e) {
      this.notices.say(`The mesh could not be shown: ${e}`, "error");
    }
  }
}
