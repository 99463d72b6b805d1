// The page: creates its parts, connects them, and runs the animation loop.

import { Connection, type Received } from "./connection";
import { ControlList } from "./controls";
import { CropBox } from "./crop";
import { element, input, onClick } from "./dom";
import { Exporter } from "./exporter";
import { Frames } from "./frames";
import { Gizmo } from "./gizmo";
import { LayerList } from "./layers";
import { Layout } from "./layout";
import { Ruler } from "./measure";
import type { View } from "./messages";
import { Navigation } from "./navigation";
import { Notices } from "./notices";
import { PathEditor } from "./path_editor";
import { type Shortcut, Shortcuts } from "./shortcuts";
import { type Box6, Stage } from "./stage";
import { Theme } from "./theme";
import { Training } from "./training";
import { Views } from "./views";

class App {
  private readonly theme = new Theme();
  private readonly connection = new Connection();
  private readonly notices = new Notices(this.connection);
  private readonly stage = new Stage(element<HTMLCanvasElement>("overlay"));
  private readonly navigation = new Navigation(this.stage, () => this.touch());
  private readonly layers = new LayerList(() => this.viewChanged());
  private readonly controls = new ControlList(() => this.touch());
  private readonly describe = (width: number, height: number): View => this.view(width, height);
  private readonly views = new Views(this.connection, this.describe, (why) => this.drawn(why));
  private readonly frames = new Frames(this.connection, (p) => this.navigation.lookFrom(p));
  private readonly crop = new CropBox(this.connection, (clip) => this.cropChanged(clip));
  private readonly ruler = new Ruler(this.connection, this.stage, this.notices, this.describe);
  private readonly path = new PathEditor(this.connection, this.stage, this.navigation, this.notices);
  private readonly exporter = new Exporter(this.connection, this.stage, this.notices, () => this.crop.clip);
  private readonly gizmo = new Gizmo((axis) => this.navigation.lookAlong(axis));
  private readonly layout = new Layout(() => this.resized());
  /** Name of the scene that is shown; null before the first scene arrives. */
  private scene: string | null = null;

  constructor() {
    new Shortcuts(this.list());
    new Training(this.connection, (on) => (this.views.training = on));
    this.connection.on("scene", (t) => this.take(t));
    this.connection.on("failed", (t) => t.view === null && this.notices.say(t.why, "error"));
    this.connection.on("saved", (t) => {
      this.notices.say(`Saved the ${t.what}: ${t.file}`, "good");
      document.body.dataset.saved = t.what;
    });
    input("frusta").addEventListener("change", () => this.showFrusta(input("frusta").checked));
    this.stage.controls.addEventListener("start", () => this.frames.leave());
    onClick("tool-home", () => this.navigation.goHome());
    onClick("tool-frusta", () => this.showFrusta(!input("frusta").checked));
    onClick("tool-crop", () => this.toggleCrop());
    onClick("tool-measure", () => this.measure());
    onClick("tool-path", () => this.addView());
    onClick("tool-full", () => fullscreen());
    element("overlay").addEventListener("dblclick", () => this.navigation.lookAtFocus(this.crop.clip ? this.crop.middle : undefined));
    new ResizeObserver(() => this.resized()).observe(element("stage"));
    if (!this.stage.hasOverlay) this.notices.say("This browser has no WebGL: cameras, crop box and meshes are not drawn", "error");
  }

  run(): void {
    this.connection.connect();
    const tick = (now: number) => {
      requestAnimationFrame(tick);
      this.path.tick(now);
      this.navigation.tick(now);
      this.stage.controls.update();
      this.stage.draw();
      this.gizmo.turn(this.stage.camera);
      if (this.scene !== null) this.views.tick(now);
    };
    requestAnimationFrame(tick);
  }

  private take(t: Received<"scene">): void {
    // After a lost connection the same scene arrives again: camera and settings stay.
    const again = this.scene === t.name;
    this.scene = t.name;
    element("name").textContent = element("name").title = t.name;
    document.title = `${t.name} – diorama`;
    document.body.dataset.run = String(t.is_run);
    element("note-text").textContent = t.note;
    element("note").hidden = t.note === "";
    this.layers.set(t.layers);
    this.controls.set(t.controls);
    this.stage.showPhotographs(t.photographs, t.distance * 0.05);
    this.frames.set(t.photographs, !again);
    this.exporter.set(t.world_from_capture);
    this.navigation.set(t.focus, t.distance, t.photographs[0], !again);
    if (!again) {
      const w = t.world_from_capture;
      this.crop.set(t.bounds, t.crop, t.focus, t.distance);
      this.ruler.set(t.measured, Math.hypot(w[0], w[4], w[8]), t.distance);
      if (t.path) this.path.open(t.path);
      if (this.views.canvas.width < 2 || document.body.dataset.views === undefined) this.notices.showEmpty("Rendering the first view", "", true);
    }
    this.viewChanged();
  }

  private view(width: number, height: number): View {
    const fov_y = (this.stage.camera.fov * Math.PI) / 180;
    const { id: layer } = this.layers;
    return { width, height, fov_y, pose: this.stage.pose(), layer, values: this.controls.values, clip: this.crop.clip };
  }

  private drawn(why: string | null): void {
    if (why === null) this.notices.showEmpty(null);
    else this.notices.showEmpty("This view could not be rendered", why);
  }

  private touch(): void {
    // Parts call this during construction.
    this.views?.touch();
    this.stage.touch();
  }

  private viewChanged(): void {
    this.controls.showFor(this.layers.id);
    this.touch();
  }

  private cropChanged(clip: Box6 | null): void {
    this.stage.showBox(clip);
    this.touch();
  }

  private resized(): void {
    const { clientWidth, clientHeight } = element("stage");
    const { aspect } = this.stage.camera;
    this.stage.resize(clientWidth, clientHeight);
    if (this.stage.camera.aspect !== aspect) this.navigation.keepShown(aspect);
    this.touch();
  }

  private showFrusta(on: boolean): void {
    input("frusta").checked = on;
    element("tool-frusta").setAttribute("aria-pressed", String(on));
    this.stage.showFrusta(on);
  }

  private toggleCrop(): void {
    this.crop.toggle();
    if (this.crop.clip) this.layout.show("crop");
  }

  private measure(): void {
    this.ruler.toggle();
    this.layout.show("measure");
  }

  private addView(): void {
    this.path.add();
    this.layout.show("path");
  }

  private list(): Shortcut[] {
    const view = "View";
    const tools = "Tools";
    const page = "Page";
    const layers = Array.from({ length: 9 }, (_, i) => ({ keys: [String(i + 1)], label: "", group: "", act: () => this.layers.chooseNumber(i) }));
    return [
      { keys: ["drag"], label: "Turn", group: "Mouse and touch" },
      { keys: ["right drag"], label: "Move; also Shift and drag, or two fingers", group: "Mouse and touch" },
      { keys: ["wheel"], label: "Zoom; also pinch", group: "Mouse and touch" },
      { keys: ["double click"], label: "Turn about the center of the scene", group: "Mouse and touch" },
      { keys: ["w", "a", "s", "d"], label: "Fly", group: view },
      { keys: ["q", "e"], label: "Fly down and up", group: view },
      { keys: ["h"], label: "Home: the first view", group: view, act: () => this.navigation.goHome() },
      { keys: ["[", "arrowleft"], label: "Previous photograph", group: view, act: () => this.frames.step(-1) },
      { keys: ["]", "arrowright"], label: "Next photograph", group: view, act: () => this.frames.step(1) },
      { keys: ["1", "…", "9"], label: "Choose a layer", group: view },
      { keys: ["c"], label: "Show cameras", group: tools, act: () => this.showFrusta(!input("frusta").checked) },
      { keys: ["b"], label: "Crop box", group: tools, act: () => this.toggleCrop() },
      { keys: ["m"], label: "Measure a length", group: tools, act: () => this.measure() },
      { keys: ["k"], label: "Add a view to the path", group: tools, act: () => this.addView() },
      { keys: ["p", " "], label: "Play or stop the path", group: tools, act: () => this.path.togglePlay() },
      { keys: ["g"], label: "Show the mesh", group: tools, act: () => this.exporter.toggleMesh() },
      { keys: ["i"], label: "Save a screenshot", group: tools, act: () => this.exporter.screenshot() },
      { keys: ["n"], label: "Show or hide the panels", group: page, act: () => this.layout.togglePanels() },
      { keys: ["l"], label: "Show or hide the photographs", group: page, act: () => this.layout.toggleStrip() },
      { keys: ["t"], label: "Theme: system, light, dark", group: page, act: () => this.theme.next() },
      { keys: ["f"], label: "Full screen", group: page, act: () => fullscreen() },
      { keys: ["?"], label: "This help", group: page },
      { keys: ["escape"], label: "Stop picking or playing", group: page, act: () => (this.ruler.stop(), this.path.stop()) },
      ...layers,
    ];
  }
}

function fullscreen(): void {
  if (document.fullscreenElement) void document.exitFullscreen();
  else void document.documentElement.requestFullscreen();
}

new App().run();
