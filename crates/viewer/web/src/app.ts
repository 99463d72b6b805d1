// The page: asks for views as fast as they come, shows what the program tells.

import * as THREE from "three";
import type { Ask, Layer, Photograph, Tell } from "./messages";
import { type Key, type PathSettings, at, fromJson, seconds, toJson } from "./path";
import { Stage, matrixOf } from "./stage";

type Box6 = NonNullable<Extract<Ask, { kind: "crop" }>["clip"]>;

const element = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;
const input = (id: string) => element<HTMLInputElement>(id);
const select = (id: string) => element<HTMLSelectElement>(id);
const button = (id: string, act: () => void) => element<HTMLButtonElement>(id).addEventListener("click", act);

/** Milliseconds that a view may take while the camera moves. */
const TARGET = 50;
/** Milliseconds of rest after which a view is drawn in full. */
const REST = 180;
const THUMBNAIL = 2 ** 31;

const token = new URLSearchParams(location.search).get("token");
const query = token ? `?token=${encodeURIComponent(token)}` : "";
const picture = element<HTMLCanvasElement>("picture");
const stage = new Stage(element<HTMLCanvasElement>("overlay"));

let socket: WebSocket;
let photographs: Photograph[] = [];
let foggy = new Set<number>();
let keys: Key[] = [];
let distance = 4;
let worldFromCapture: number[] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];
let crop: Box6 = [-1, -1, -1, 1, 1, 1];
let rule: number[][] = [];
let picking = false;
let training = false;
let nextId = 0;
let asked: { id: number; when: number; scale: number } | null = null;
let scale = 0.3;
let shown = 0;
let dirty = true;
let moved = 0;
let playing: number | null = null;
let fps = 0;

function send(ask: Ask): void {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(ask));
}

function say(text: string): void {
  element("message").textContent = text;
}

function touch(): void {
  dirty = true;
  stage.touch();
  moved = performance.now();
}

function clip(): Box6 | null {
  return input("crop").checked ? crop : null;
}

function connect(): void {
  socket = new WebSocket(`ws://${location.host}/socket${query}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (e) => (typeof e.data === "string" ? hear(JSON.parse(e.data) as Tell) : see(e.data as ArrayBuffer));
  socket.onclose = () => {
    element("status").textContent = "connection lost; trying again…";
    asked = null;
    setTimeout(connect, 1000);
  };
}

function hear(tell: Tell): void {
  switch (tell.kind) {
    case "scene": {
      const first = photographs.length === 0;
      photographs = tell.photographs;
      distance = tell.distance;
      worldFromCapture = tell.world_from_capture;
      element("name").textContent = tell.name;
      document.title = `${tell.name} – diorama`;
      // Cameras right before the eye would hide everything.
      stage.camera.near = distance * 0.1;
      stage.camera.far = distance * 50;
      stage.showPhotographs(photographs, distance * 0.05);
      if (first) {
        crop = tell.crop ?? inner(tell.bounds, tell.focus);
        input("crop").checked = tell.crop !== null;
        sides(tell.bounds);
        strip();
        stage.controls.target.set(...tell.focus);
        const p = photographs[0];
        if (p) lookFrom(p);
        if (tell.path) openPath(tell.path);
        if (tell.measured) {
          rule = [tell.measured.slice(0, 3), tell.measured.slice(3, 6)];
          input("measure-length").value = String(tell.measured[6] * 100);
        }
        ruleChanged();
      }
      touch();
      break;
    }
    case "status":
      training = tell.running;
      element("status").textContent = tell.running
        ? `training: step ${tell.step}, ${tell.psnr.toFixed(2)} dB${heldOut(tell.held_out)}, ${Math.round(tell.rays_per_s)} rays/s`
        : `step ${tell.step}${heldOut(tell.held_out)}`;
      break;
    case "fog":
      foggy = new Set(tell.frames);
      markFog();
      break;
    case "path":
      openPath(tell.json);
      break;
    case "picked":
      if (!tell.point) say("nothing is there; click on the thing");
      else if (rule.push(tell.point) === 2) picking = false;
      ruleChanged();
      break;
    case "working":
      say(`${tell.what}: ${tell.percent} %`);
      break;
    case "exported":
      say(`made ${tell.file}`);
      if (tell.glb) {
        element<HTMLAnchorElement>("mesh-link").href = `mesh.glb${query}`;
        element("mesh-link").hidden = false;
        stage.loadMesh(`mesh.glb${query}`, worldFromCapture, tell.scale).then(() => {
          element("mesh-note").textContent = "";
          input("mesh").checked = true;
          stage.showMesh(true);
          stage.touch();
          document.body.dataset.mesh = "shown";
        }, (e) => say(`the mesh cannot be shown: ${e}`));
      }
      break;
    case "saved":
      say(`saved ${tell.what}: ${tell.file}`);
      document.body.dataset.saved = tell.what;
      break;
    case "failed":
      say(tell.why);
      break;
  }
}

async function see(data: ArrayBuffer): Promise<void> {
  const id = new DataView(data).getUint32(0, true);
  const blob = new Blob([new Uint8Array(data, 4)], { type: "image/jpeg" });
  if (id >= THUMBNAIL) {
    const img = document.querySelector<HTMLImageElement>(`#photographs img[data-frame="${id - THUMBNAIL}"]`);
    if (img) img.src = URL.createObjectURL(blob);
    return;
  }
  const bitmap = await createImageBitmap(blob);
  picture.width = bitmap.width;
  picture.height = bitmap.height;
  picture.getContext("2d")?.drawImage(bitmap, 0, 0);
  document.body.dataset.views = String(Number(document.body.dataset.views ?? 0) + 1);
  if (asked?.id === id) {
    const took = performance.now() - asked.when;
    shown = asked.scale;
    fps = 0.8 * fps + 0.2 * (1000 / Math.max(took, 1));
    document.body.dataset.took = took.toFixed(1);
    document.body.dataset.scale = shown.toFixed(3);
    if (asked.scale < 1) {
      // The time goes with the number of pixels, the square of the scale.
      const wanted = asked.scale * Math.sqrt(TARGET / Math.max(took, 1));
      scale = Math.min(1, Math.max(0.1, 0.6 * scale + 0.4 * wanted));
    }
    asked = null;
  }
}

function ask(at: number): void {
  const width = Math.max(16, Math.round(picture.clientWidth * at));
  const height = Math.max(16, Math.round(picture.clientHeight * at));
  const layer = select("layer").value as Layer;
  const fov_y = (stage.camera.fov * Math.PI) / 180;
  asked = { id: nextId++, when: performance.now(), scale: at };
  dirty = false;
  const pose = stage.pose() as Extract<Ask, { kind: "view" }>["pose"];
  send({ kind: "view", id: asked.id, width, height, fov_y, pose, layer, clip: clip() });
}

function tick(now: number): void {
  requestAnimationFrame(tick);
  if (playing !== null) play(now);
  fly(now);
  stage.controls.update();
  stage.draw();
  if (asked || socket.readyState !== WebSocket.OPEN || photographs.length === 0) return;
  const rest = now - moved;
  if (dirty) ask(Math.min(scale, 0.999));
  else if (rest > REST && shown < 1) ask(shown < 0.5 ? 0.5 : 1);
  else if (training && rest > 2000 && Math.floor(now / 2000) !== Math.floor((now - 20) / 2000)) ask(0.5);
}

let flown = 0;

/** Moves the camera by the keys that are held, a third of its distance a second. */
function fly(now: number): void {
  const seconds = Math.min((now - flown) / 1000, 0.1);
  flown = now;
  if (held.size === 0) return;
  const along = (plus: string, minus: string) => Number(held.has(plus)) - Number(held.has(minus));
  stage.fly(along("d", "a"), along("e", "q"), along("w", "s"), (distance / 3) * seconds);
  touch();
}

function lookFrom(p: Photograph): void {
  setFov((p.fov_y * 180) / Math.PI);
  stage.lookFrom(matrixOf(p.pose), distance);
  touch();
}

function setFov(degrees: number): void {
  stage.camera.fov = degrees;
  stage.camera.updateProjectionMatrix();
  input("fov").value = String(Math.round(degrees));
  element("fov-out").textContent = `${Math.round(degrees)}°`;
}

/** The middle of what may be shown, no larger than the cameras' distance. */
function inner(bounds: number[], focus: number[]): Box6 {
  const low = [0, 1, 2].map((k) => Math.max(bounds[k]!, focus[k]! - distance / 2));
  const high = [0, 1, 2].map((k) => Math.min(bounds[k + 3]!, focus[k]! + distance / 2));
  return [...low, ...high] as Box6;
}

function sides(bounds: number[]): void {
  const place = element("crop-sides");
  place.replaceChildren();
  for (let k = 0; k < 6; k++) {
    const axis = k % 3;
    const label = document.createElement("label");
    const range = document.createElement("input");
    range.type = "range";
    range.id = `crop-${"xyz"[axis]}${k < 3 ? 0 : 1}`;
    range.min = String(bounds[axis]);
    range.max = String(bounds[axis + 3]);
    range.step = "any";
    range.value = String(crop[k]);
    range.addEventListener("input", () => {
      const v = Number(range.value);
      const other = crop[(k + 3) % 6]!;
      const gap = (bounds[axis + 3]! - bounds[axis]!) * 0.01;
      crop[k] = k < 3 ? Math.min(v, other - gap) : Math.max(v, other + gap);
      input("crop").checked = true;
      cropChanged();
    });
    label.append(`${"xyz"[axis]} ${k < 3 ? "from" : "to"}`, range);
    place.append(label);
  }
  cropChanged();
}

function cropChanged(): void {
  stage.showBox(clip());
  touch();
}

/** Length of a unit of the capture in the world. */
function unit(): number {
  return Math.hypot(worldFromCapture[0]!, worldFromCapture[4]!, worldFromCapture[8]!);
}

function ruleChanged(): void {
  stage.showRule(rule, distance * 0.006);
  const [a, b] = rule;
  const apart = a && b ? Math.hypot(...a.map((v, k) => v - b[k]!)) / unit() : 0;
  element("measure-note").textContent = a && b
    ? `${apart.toPrecision(4)} units of the capture apart`
    : picking ? `click the ${a ? "second" : "first"} point` : "of a length that you know";
  element("measure").classList.toggle("on", picking);
}

/** Asks which point a click means. */
function pick(e: PointerEvent): void {
  const box = picture.getBoundingClientRect();
  const pose = stage.pose() as Extract<Ask, { kind: "view" }>["pose"];
  const [width, height] = [Math.round(box.width), Math.round(box.height)];
  const fov_y = (stage.camera.fov * Math.PI) / 180;
  send({ kind: "pick", x: e.clientX - box.left, y: e.clientY - box.top, width, height, fov_y, pose, clip: clip() });
}

function strip(): void {
  const place = element("photographs");
  place.replaceChildren();
  const some = Math.ceil(photographs.length / 200);
  photographs.forEach((p, i) => {
    if (i % some !== 0) return;
    const b = document.createElement("button");
    b.className = p.held_out ? "held-out" : "";
    b.dataset.frame = String(i);
    const img = document.createElement("img");
    img.dataset.frame = String(i);
    img.alt = p.name;
    b.append(img);
    b.addEventListener("click", () => lookFrom(p));
    place.append(b);
  });
  markFog();
  // Pictures are fetched when they come into sight.
  const seen = new IntersectionObserver((entries) => {
    for (const e of entries.filter((e) => e.isIntersecting)) {
      seen.unobserve(e.target);
      send({ kind: "thumbnail", frame: Number((e.target as HTMLElement).dataset.frame) });
    }
  });
  place.querySelectorAll("img").forEach((i) => seen.observe(i));
}

const heldOut = (psnr: number | null) => (psnr === null ? "" : `, held out ${psnr.toFixed(2)} dB`);

/** Marks the photographs that the field shows through fog. */
function markFog(): void {
  document.querySelectorAll<HTMLElement>("#photographs button").forEach((b) => {
    const frame = Number(b.dataset.frame);
    const p = photographs[frame];
    b.classList.toggle("fog", foggy.has(frame));
    b.title = (p?.name ?? "") + (p?.held_out ? " (held out)" : "") + (foggy.has(frame) ? " (behind fog)" : "");
  });
  document.body.dataset.fog = String(foggy.size);
}

function settings(): PathSettings {
  const number = (id: string) => Number(input(id).value);
  return {
    secondsPerView: number("key-seconds") || 2,
    fps: number("key-fps") || 24,
    width: Math.round(number("key-width")) || 1280,
    height: Math.round(number("key-height")) || 720,
    cycle: input("key-cycle").checked,
  };
}

function keysChanged(): void {
  const list = element("keys");
  list.replaceChildren(...keys.map((k, i) => {
    const item = document.createElement("li");
    const go = document.createElement("button");
    go.textContent = "go";
    go.addEventListener("click", () => goTo(k));
    const drop = document.createElement("button");
    drop.textContent = "×";
    drop.title = "remove";
    drop.addEventListener("click", () => {
      keys.splice(i, 1);
      keysChanged();
    });
    item.append(go, drop, ` ${Math.round(k.fov)}°`);
    return item;
  }));
  const n = 100;
  const cycle = settings().cycle;
  const points = keys.length > 1 ? Array.from({ length: n + 1 }, (_, i) => at(keys, i / n, cycle)) : [];
  stage.showPath(points.map((p) => new THREE.Vector3().setFromMatrixPosition(p.matrix)));
  stage.touch();
}

function goTo(k: Key): void {
  setFov(k.fov);
  stage.lookFrom(k.matrix, distance);
  touch();
}

function play(now: number): void {
  const s = settings();
  const t = (now - playing!) / 1000 / seconds(keys, s);
  goTo(at(keys, t, s.cycle));
  if (t >= 1) playing = null;
}

function openPath(json: string): void {
  try {
    const p = fromJson(json);
    keys = p.keys;
    input("key-seconds").value = p.settings.secondsPerView.toFixed(2);
    input("key-fps").value = String(p.settings.fps);
    input("key-width").value = String(p.settings.width);
    input("key-height").value = String(p.settings.height);
    input("key-cycle").checked = p.settings.cycle;
    keysChanged();
  } catch (e) {
    say(`the camera path cannot be read: ${e}`);
  }
}

function download(name: string, href: string): void {
  const a = document.createElement("a");
  a.href = href;
  a.download = name;
  a.click();
}

function savePath(): boolean {
  if (keys.length === 0) {
    say("add a view first");
    return false;
  }
  send({ kind: "path", json: toJson(keys, settings()) });
  return true;
}

button("key-add", () => {
  stage.camera.updateMatrixWorld();
  keys.push({ matrix: stage.camera.matrixWorld.clone(), fov: stage.camera.fov });
  keysChanged();
});
button("key-clear", () => {
  keys = [];
  keysChanged();
});
button("key-play", () => {
  playing = keys.length > 1 && playing === null ? performance.now() : null;
});
button("path-save", savePath);
button("path-download", () => {
  // Saved first: the file has the cameras in the capture's own frame.
  if (savePath()) setTimeout(() => download("camera_path.json", `camera_path.json${query}`), 300);
});
input("path-open").addEventListener("change", async () => {
  const file = input("path-open").files?.[0];
  if (file) send({ kind: "open_path", json: await file.text() });
});
input("key-cycle").addEventListener("change", keysChanged);
input("crop").addEventListener("change", cropChanged);
button("crop-save", () => send({ kind: "crop", clip: clip() }));
input("frusta").addEventListener("change", () => {
  stage.showFrusta(input("frusta").checked);
  stage.touch();
});
input("mesh").addEventListener("change", () => {
  if (!stage.showMesh(input("mesh").checked)) say("export a GLB first");
  stage.touch();
});
select("layer").addEventListener("change", touch);
input("fov").addEventListener("input", () => {
  setFov(Number(input("fov").value));
  touch();
});
button("export", () => {
  const format = select("format").value;
  say("making the mesh…");
  send({ kind: "export", format, faces: Number(input("faces").value) | 0, resolution: Number(input("resolution").value) | 0, clip: clip() });
});
button("measure", () => {
  rule = [];
  picking = true;
  ruleChanged();
});
button("measure-clear", () => {
  rule = [];
  picking = false;
  ruleChanged();
  send({ kind: "measured", points: null, metres: 1 });
});
button("measure-save", () => {
  const metres = Number(input("measure-length").value) * Number(select("measure-unit").value);
  if (rule.length < 2) say("pick two points first");
  else send({ kind: "measured", points: rule.flat() as [number, number, number, number, number, number], metres });
});
button("screenshot", () => {
  const both = document.createElement("canvas");
  both.width = picture.width;
  both.height = picture.height;
  const g = both.getContext("2d");
  g?.drawImage(picture, 0, 0);
  if (input("frusta").checked || input("mesh").checked || input("crop").checked) {
    g?.drawImage(element<HTMLCanvasElement>("overlay"), 0, 0, both.width, both.height);
  }
  download("diorama.png", both.toDataURL("image/png"));
});
stage.controls.addEventListener("change", touch);
/** Keys that are held: w a s d fly, q and e sink and rise. */
const held = new Set<string>();
window.addEventListener("keydown", (e) => {
  if (e.target instanceof HTMLInputElement || e.target instanceof HTMLSelectElement || e.ctrlKey || e.metaKey || e.altKey) return;
  if ("wasdqe".includes(e.key.toLowerCase())) held.add(e.key.toLowerCase());
});
window.addEventListener("keyup", (e) => held.delete(e.key.toLowerCase()));
window.addEventListener("blur", () => held.clear());
let pressed = [0, 0];
element("overlay").addEventListener("pointerdown", (e) => {
  playing = null;
  pressed = [e.clientX, e.clientY];
});
element("overlay").addEventListener("pointerup", (e) => {
  // A drag turns, a click picks.
  if (picking && Math.hypot(e.clientX - pressed[0]!, e.clientY - pressed[1]!) < 4) pick(e);
});
element("overlay").addEventListener("dblclick", () => {
  stage.controls.target.set(...(photographs.length ? focusOf() : [0, 0, 0]) as [number, number, number]);
  touch();
});

/** The middle of the crop box, about which to turn. */
function focusOf(): number[] {
  return [0, 1, 2].map((k) => (crop[k]! + crop[k + 3]!) / 2);
}

new ResizeObserver(() => {
  stage.resize(picture.clientWidth, picture.clientHeight);
  touch();
}).observe(element("stage"));
setInterval(() => {
  element("hint").dataset.fps = fps.toFixed(1);
}, 1000);
if (!stage.hasOverlay) say("this browser has no WebGL: cameras, crop box and meshes are not drawn");
connect();
requestAnimationFrame(tick);
