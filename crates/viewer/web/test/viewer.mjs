// Drives the viewer of a run in headless Chromium: node test/viewer.mjs DIORAMA RUN [PICTURES]
// Prints a line per check and fails with the first that does not hold.

import { execFileSync, spawn } from "node:child_process";
import { existsSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import net from "node:net";
import os from "node:os";
import path from "node:path";
import { chromium } from "playwright-core";

const [diorama, run, pictures] = process.argv.slice(2);
const until = async (what, f, seconds = 60) => {
  for (const end = Date.now() + seconds * 1000; Date.now() < end; await new Promise((r) => setTimeout(r, 50))) {
    const v = await f();
    if (v) return v;
  }
  throw new Error(`waited ${seconds} s for ${what}`);
};
let checks = 0;
const check = (what, ok, detail = "") => {
  if (!ok) throw new Error(`FAILED: ${what} ${detail}`);
  checks += 1;
  console.log(`ok  ${what} ${detail}`);
};

/** Starts a viewer; its address and how to end it. */
async function viewer(what, ...flags) {
  const child = spawn(diorama, ["view", what, "--port", "0", "--json", "--device", "cpu", ...flags], { stdio: ["ignore", "pipe", "inherit"] });
  let out = "";
  child.stdout.on("data", (d) => (out += d));
  const line = await until("the viewer's address", () => out.includes("\n") && out);
  return { address: JSON.parse(line).address, end: () => new Promise((r) => (child.on("exit", r), child.kill("SIGINT"))) };
}

/** Starts training with a viewer on the capture of a run; its address, what it says, and how it ends. */
async function training(out) {
  const flags = ["--seconds", "60", "--view", "--port", "0", "--device", "cpu", "--set", "field.log2_size=15"];
  const child = spawn(diorama, ["train", path.join(run, "capture"), "-o", out, ...flags], { stdio: ["ignore", "ignore", "pipe"] });
  let said = "";
  child.stderr.on("data", (d) => (said += d));
  const ended = new Promise((r) => child.on("exit", r));
  const address = await until("the address", () => said.match(/view: (http\S+)/)?.[1]);
  return { address, stop: () => (child.kill("SIGINT"), ended), said: () => said };
}

/** Sends a request as it stands; the answer's status. */
function raw(port, lines, host = "127.0.0.1") {
  return new Promise((resolve, reject) => {
    const s = net.connect(port, host, () => s.write(lines.join("\r\n") + "\r\n\r\n"));
    let text = "";
    s.on("data", (d) => {
      text += d;
      const m = text.match(/^HTTP\/1\.1 (\d+)/);
      if (m) (s.destroy(), resolve(Number(m[1])));
    });
    s.on("error", reject);
    s.on("close", () => resolve(0));
  });
}

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"],
});
let ends = [];
try {
  const { address, end } = await viewer(run);
  ends.push(end);
  const { port, host } = new URL(address);

  // Who else may not ask.
  const upgrade = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="];
  const socket = (...h) => raw(port, ["GET /socket HTTP/1.1", ...h, ...upgrade]);
  check("the own page's socket is opened", (await socket(`Host: ${host}`, `Origin: http://${host}`)) === 101);
  check("a foreign Origin is refused", (await socket(`Host: ${host}`, "Origin: http://evil.example")) === 403);
  check("a missing Origin is refused", (await socket(`Host: ${host}`)) === 403);
  check("a wrong Host is refused", (await raw(port, ["GET / HTTP/1.1", `Host: evil.example:${port}`])) === 403);
  check("a path out of the page is not served", (await raw(port, ["GET /../config.toml HTTP/1.1", `Host: ${host}`])) === 404);
  check("another method is refused", (await raw(port, ["POST / HTTP/1.1", `Host: ${host}`])) === 405);
  const open = await viewer(run, "--host", "0.0.0.0");
  ends.push(open.end);
  const far = new URL(open.address);
  check("a missing token is refused", (await raw(far.port, ["GET / HTTP/1.1", `Host: ${far.host}`])) === 401);
  check("a wrong token is refused", (await raw(far.port, [`GET /?token=${"0".repeat(32)} HTTP/1.1`, `Host: ${far.host}`])) === 401);
  check("the printed token is accepted", (await raw(far.port, [`GET /?${far.searchParams} HTTP/1.1`, `Host: ${far.host}`])) === 200);

  // A page of another site in the same browser.
  const page = await browser.newPage({ viewport: { width: 1000, height: 700 } });
  await page.goto("data:text/html,<p>elsewhere");
  const foreign = await page.evaluate((a) => new Promise((r) => {
    const s = new WebSocket(a.replace("http", "ws") + "socket");
    s.onopen = () => r("opened");
    s.onerror = () => r("refused");
  }), address);
  check("a socket from another site's page is refused", foreign === "refused");

  // The page itself.
  const complaints = [];
  const requests = [];
  page.on("console", (m) => m.type() === "error" && complaints.push(m.text()));
  page.on("pageerror", (e) => complaints.push(String(e)));
  page.on("request", (r) => requests.push(r.url()));
  await page.goto(address);
  const views = () => page.evaluate(() => Number(document.body.dataset.views ?? 0));
  const scale = () => page.evaluate(() => Number(document.body.dataset.scale ?? 0));
  const settled = async () => {
    await page.waitForTimeout(300);
    await until("a whole view", async () => (await scale()) === 1);
  };
  const picture = () => page.evaluate(() => {
    const c = document.getElementById("picture");
    const small = document.createElement("canvas");
    [small.width, small.height] = [64, 48];
    const g = small.getContext("2d");
    g.drawImage(c, 0, 0, 64, 48);
    return [...g.getImageData(0, 0, 64, 48).data].filter((_, i) => i % 4 < 3);
  });
  const difference = (a, b) => a.reduce((s, v, i) => s + Math.abs(v - b[i]), 0) / a.length;
  const shot = async (name) => pictures && (await page.screenshot({ path: path.join(pictures, `${name}.png`) }));
  await until("a view", async () => (await views()) > 0);
  await settled();
  const first = await picture();
  const spread = Math.max(...first) - Math.min(...first);
  check("a view is shown", spread > 40, `(brightness spans ${spread})`);
  await shot("first");
  await page.locator("#photographs button").first().scrollIntoViewIfNeeded();
  const thumbs = await until("thumbnails", () => page.evaluate(() => [...document.querySelectorAll("#photographs img")].filter((i) => i.naturalWidth > 0).length));
  check("photographs are listed", thumbs > 0, `(${thumbs} in sight)`);

  // Orbit.
  const box = await page.locator("#overlay").boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  const before = await views();
  await page.mouse.move(x, y);
  await page.mouse.down();
  const begin = Date.now();
  for (let i = 1; i <= 60; i++) {
    await page.mouse.move(x + 3 * i, y + i / 2);
    await page.waitForTimeout(16);
  }
  await page.mouse.up();
  const rate = ((await views()) - before) / ((Date.now() - begin) / 1000);
  await settled();
  const turned = await picture();
  check("orbit changes the image", difference(first, turned) > 5, `(mean difference ${difference(first, turned).toFixed(1)}, ${rate.toFixed(1)} views per second while turning)`);
  await shot("turned");

  // Flying.
  await page.keyboard.down("w");
  await page.waitForTimeout(400);
  await page.keyboard.up("w");
  await settled();
  check("keys fly", difference(turned, await picture()) > 1);
  await page.keyboard.down("s");
  await page.waitForTimeout(400);
  await page.keyboard.up("s");
  await settled();

  // Layers.
  const seen = { rgb: turned };
  for (const layer of ["depth", "normal", "opacity", "occupancy"]) {
    const n = await views();
    await page.selectOption("#layer", layer);
    await until(`layer ${layer}`, async () => (await views()) > n);
    await settled();
    seen[layer] = await picture();
    const nearest = Math.min(...Object.entries(seen).filter(([k]) => k !== layer).map(([, p]) => difference(p, seen[layer])));
    check(`layer ${layer} is another picture`, nearest > 2, `(mean difference ${nearest.toFixed(1)})`);
    await shot(layer);
  }
  await page.selectOption("#layer", "rgb");
  await settled();

  // Crop box.
  const whole = await picture();
  await page.evaluate(() => {
    const r = document.getElementById("crop-x0");
    r.value = String((Number(r.min) + 3 * Number(r.max)) / 4 > Number(document.getElementById("crop-x1").value)
      ? (Number(r.min) + Number(document.getElementById("crop-x1").value)) / 2 : (Number(r.min) + Number(r.max)) / 2);
    r.dispatchEvent(new Event("input"));
  });
  await settled();
  const cropped = await picture();
  check("the crop box changes the image", difference(whole, cropped) > 1, `(mean difference ${difference(whole, cropped).toFixed(1)})`);
  await shot("cropped");
  await page.click("#crop-save");
  await until("crop.json", () => existsSync(path.join(run, "crop.json")));
  const crop = JSON.parse(readFileSync(path.join(run, "crop.json")));
  const shownBox = await page.evaluate(() => [0, 1].map((end) => ["x", "y", "z"].map((axis) => Number(document.getElementById(`crop-${axis}${end}`).value))));
  const kept = [crop.min, crop.max].every((corner, end) => corner.every((v, k) => Math.abs(v - shownBox[end][k]) < 1e-4));
  check("the crop box is kept as it is shown", kept, `(${JSON.stringify(crop)})`);

  // Camera path.
  await page.click("#key-add");
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x + 150, y, { steps: 8 });
  await page.mouse.up();
  await page.click("#key-add");
  await page.fill("#key-seconds", "0.5");
  await page.click("#path-save");
  const file = path.join(run, "camera_path.json");
  await until("camera_path.json", () => existsSync(file));
  const saved = JSON.parse(readFileSync(file));
  check("the camera path is kept", saved.keyframes.length === 2 && saved.camera_path.length === 12, `(${saved.camera_path.length} cameras)`);
  const still = await views();
  await page.click("#key-play");
  await until("the path's preview", async () => (await views()) > still + 2);
  await page.click("#key-clear");
  await page.setInputFiles("#path-open", file);
  await until("the keys of an opened path", () => page.evaluate(() => document.querySelectorAll("#keys li").length === 2));
  check("a saved path is opened again", true);

  // Scale: two points a known length apart.
  // Where something dark stands before the white: the page's places of two such pixels far apart.
  await settled();
  const [one, two] = await page.evaluate(() => {
    const c = document.getElementById("picture");
    const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    const dark = Array.from({ length: d.length / 4 }, (_, i) => i).filter((i) => d[4 * i] + d[4 * i + 1] + d[4 * i + 2] < 240);
    dark.sort((a, b) => (a % c.width) - (b % c.width));
    const box = c.getBoundingClientRect();
    const place = (i) => [box.left + ((i % c.width + 0.5) * box.width) / c.width, box.top + ((Math.floor(i / c.width) + 0.5) * box.height) / c.height];
    return [dark[Math.floor(dark.length * 0.3)], dark[Math.floor(dark.length * 0.7)]].map(place);
  });
  await page.click("#measure");
  await page.mouse.click(...one);
  await until("the first point", () => page.evaluate(() => document.getElementById("measure-note").textContent.includes("second")));
  await page.mouse.click(...two);
  await until("the second point", () => page.evaluate(() => document.getElementById("measure-note").textContent.includes("units of the capture apart")));
  await page.fill("#measure-length", "25");
  await page.click("#measure-save");
  await until("scale.json", () => existsSync(path.join(run, "scale.json")));
  const scaled = JSON.parse(readFileSync(path.join(run, "scale.json")));
  const apart = Math.hypot(...scaled.points[0].map((v, k) => v - scaled.points[1][k]));
  check("a measured length is kept for export", scaled.metres === 0.25 && apart > 0.05 && apart < 2, `(${apart.toFixed(3)} units are 25 cm)`);
  await shot("measured");

  // Mesh.
  await page.fill("#faces", "5000");
  await page.fill("#resolution", "64");
  await page.click("#export");
  await until("a mesh in the page", () => page.evaluate(() => document.body.dataset.mesh === "shown"), 180);
  await settled();
  await shot("mesh");
  const glb = readFileSync(path.join(run, "mesh.glb"));
  check("a GLB is made and shown", glb.subarray(0, 4).toString() === "glTF", `(${glb.length >> 10} KiB)`);
  const extents = (bytes) => {
    const root = JSON.parse(bytes.subarray(20, 20 + bytes.readUInt32LE(12)));
    const at = root.accessors[root.meshes[0].primitives[0].attributes.POSITION];
    return at.max.map((v, k) => v - at.min[k]);
  };
  // The same box without the measured length, in units of the capture.
  const unscaled = path.join(run, "unscaled.glb");
  execFileSync(diorama, ["export", run, "-o", unscaled, "--scale", "1", "--faces", "5000", "--resolution", "64", "--device", "cpu", "--force"]);
  const [inMeters, inUnits] = [glb, readFileSync(unscaled)].map(extents);
  const off = Math.max(...inMeters.map((v, k) => Math.abs(v / inUnits[k] / (0.25 / apart) - 1)));
  check("the mesh has the measured scale", off < 0.01, `(${inMeters.map((v) => v.toFixed(3)).join(" x ")} m, ${(100 * off).toFixed(2)} % off)`);
  const [download] = await Promise.all([page.waitForEvent("download"), page.click("#screenshot")]);
  const folder = mkdtempSync(path.join(os.tmpdir(), "viewer-"));
  await download.saveAs(path.join(folder, "s.png"));
  check("a screenshot is saved", readFileSync(path.join(folder, "s.png")).subarray(1, 4).toString() === "PNG");
  rmSync(folder, { recursive: true });

  // Training shows itself.
  const runs = mkdtempSync(path.join(os.tmpdir(), "viewer-"));
  const live = await training(path.join(runs, "live"));
  ends.push(live.stop);
  const other = await browser.newPage({ viewport: { width: 700, height: 500 } });
  other.on("console", (m) => m.type() === "error" && complaints.push(m.text()));
  other.on("pageerror", (e) => complaints.push(String(e)));
  await other.goto(live.address);
  const step = () => other.evaluate(() => Number(document.getElementById("status").textContent.match(/step (\d+)/)?.[1] ?? 0));
  const early = await until("a step", step);
  const shown = () => other.evaluate(() => Number(document.body.dataset.views ?? 0));
  const seenViews = await until("a view in training", shown);
  const later = await until("later steps", async () => (await step()) > early + 50 && (await step()));
  await until("views without a touch", async () => (await shown()) > seenViews + 2);
  await until("held-out pixels", () => other.evaluate(() => /held out \d+\.\d+ dB/.test(document.getElementById("status").textContent)));
  check("training shows held-out beside training PSNR, and how many views are behind fog", await other.evaluate(() => document.body.dataset.fog !== undefined));
  check("training shows its steps and views by itself", true, `(steps ${early} to ${later})`);
  if (pictures) await other.screenshot({ path: path.join(pictures, "training.png") });
  const code = await live.stop();
  check("Ctrl-C ends training and viewer with a checkpoint", code === 130 && existsSync(path.join(runs, "live", "checkpoints")), `(exit code ${code})`);
  await other.close();
  rmSync(runs, { recursive: true });

  // A data set and a file of splats, before there is any run.
  const cloud = path.join(mkdtempSync(path.join(os.tmpdir(), "viewer-")), "ball.ply");
  const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
  const rows = Array.from({ length: 600 }, (_, i) => {
    const [z, a] = [1 - (2 * i + 1) / 600, i * 2.4];
    const r = Math.sqrt(1 - z * z);
    return [r * Math.cos(a), r * Math.sin(a), z, 1.5 * z, -1.5 * z, 0, 5, -2.5, -2.5, -2.5, 1, 0, 0, 0].join(" ");
  });
  const head = `ply\nformat ascii 1.0\nelement vertex 600\n${names.map((n) => `property float ${n}\n`).join("")}end_header\n`;
  writeFileSync(cloud, head + rows.join("\n") + "\n");
  for (const [name, what] of [["a file of splats", cloud], ["a data set", path.join(run, "capture")]]) {
    const there = await viewer(what);
    ends.push(there.end);
    const look = await browser.newPage({ viewport: { width: 800, height: 500 } });
    look.on("console", (m) => m.type() === "error" && complaints.push(m.text()));
    look.on("pageerror", (e) => complaints.push(String(e)));
    await look.goto(there.address);
    await until("a view", () => look.evaluate(() => Number(document.body.dataset.views ?? 0) > 0));
    await until("a whole view", () => look.evaluate(() => Number(document.body.dataset.scale ?? 0) === 1));
    await look.locator("#photographs button").first().scrollIntoViewIfNeeded();
    const pictures8 = await until("thumbnails", () => look.evaluate(() => [...document.querySelectorAll("#photographs img")].filter((i) => i.naturalWidth > 0).length));
    const colors = await look.evaluate(() => {
      const c = document.getElementById("picture");
      const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
      return new Set(Array.from({ length: d.length / 4 }, (_, i) => `${d[4 * i] >> 5} ${d[4 * i + 1] >> 5}`)).size;
    });
    check(`${name} is shown`, pictures8 > 0 && colors >= (what === cloud ? 8 : 1), `(${colors} colours, ${pictures8} pictures)`);
    if (pictures) await look.screenshot({ path: path.join(pictures, `${name}.png`) });
    await look.close();
  }
  rmSync(path.dirname(cloud), { recursive: true });

  check("nothing is fetched from elsewhere", requests.every((r) => r.startsWith(address) || r.startsWith("blob:") || r.startsWith("data:")), `(${requests.length} requests)`);
  check("the console has no errors", complaints.length === 0, complaints.join("; "));
  console.log(`${checks} checks passed`);
} catch (e) {
  console.error(String(e));
  process.exitCode = 1;
} finally {
  await browser.close();
  await Promise.all(ends.map((e) => e()));
}
