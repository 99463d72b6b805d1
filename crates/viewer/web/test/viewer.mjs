// Drives the viewer of a run in headless Chromium: node test/viewer.mjs DIORAMA RUN [PICTURES]
// Prints a line per check and ends at the first one that fails.

import { execFileSync } from "node:child_process";
import { existsSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import os from "node:os";
import path from "node:path";
import { chromium } from "playwright-core";
import { lostAndFailed, ownLists, phone, shortcuts, themes } from "./appearance.mjs";
import { Page, check, checked, complaints, difference, diorama, endAll, raw, requests, run, training, until, viewer } from "./driver.mjs";

const scratch = mkdtempSync(path.join(os.tmpdir(), "viewer-"));

/** Requests that must be refused. */
async function guarded(browser, address) {
  const { port, host } = new URL(address);
  const upgrade = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="];
  const socket = (...h) => raw(port, ["GET /socket HTTP/1.1", ...h, ...upgrade]);
  check("the own page's socket is opened", (await socket(`Host: ${host}`, `Origin: http://${host}`)) === 101);
  check("a foreign Origin is refused", (await socket(`Host: ${host}`, "Origin: http://evil.example")) === 403);
  check("a missing Origin is refused", (await socket(`Host: ${host}`)) === 403);
  check("a wrong Host is refused", (await raw(port, ["GET / HTTP/1.1", `Host: evil.example:${port}`])) === 403);
  check("a path out of the page is not served", (await raw(port, ["GET /../config.toml HTTP/1.1", `Host: ${host}`])) === 404);
  check("another method is refused", (await raw(port, ["POST / HTTP/1.1", `Host: ${host}`])) === 405);
  const open = await viewer(run, 0, "--host", "0.0.0.0");
  const far = new URL(open.address);
  check("a missing token is refused", (await raw(far.port, ["GET / HTTP/1.1", `Host: ${far.host}`])) === 401);
  check("a wrong token is refused", (await raw(far.port, [`GET /?token=${"0".repeat(32)} HTTP/1.1`, `Host: ${far.host}`])) === 401);
  check("the printed token is accepted", (await raw(far.port, [`GET /?${far.searchParams} HTTP/1.1`, `Host: ${far.host}`])) === 200);
  const withToken = await Page.open(browser, open.address);
  check("the page with the token connects", (await withToken.views()) > 0);
  await withToken.close();
  await open.end();

  // A page of another site in the same browser.
  const page = await browser.newPage();
  await page.goto("data:text/html,<p>elsewhere");
  const foreign = await page.evaluate((a) => new Promise((r) => {
    const s = new WebSocket(a.replace("http", "ws") + "socket");
    s.onopen = () => r("opened");
    s.onerror = () => r("refused");
  }), address);
  check("a socket from another site's page is refused", foreign === "refused");
  await page.close();
}

/** Views from other poses and of every layer. */
async function looking(p) {
  const { page } = p;
  const first = await p.picture();
  const spread = Math.max(...first) - Math.min(...first);
  check("a view is shown", spread > 40, `(brightness spans ${spread})`);
  await p.shot("first");
  check("photographs are listed", await p.thumbnails(3));
  await until("the curve", () => p.shown("#charts .chart"));
  check("a trained run shows its curve and figures", /\d+\.\d+ dB/.test(await p.text("dd[data-figure=psnr]")) && /\d+\.\d+ dB/.test(await p.text("dd[data-figure=val_psnr]")));

  const before = await p.views();
  const begin = Date.now();
  await p.drag(180, 30, 60, 16);
  const rate = ((await p.views()) - before) / ((Date.now() - begin) / 1000);
  const turned = await p.picture();
  check("orbit changes the image", difference(first, turned) > 5, `(mean difference ${difference(first, turned).toFixed(1)}, ${rate.toFixed(1)} views per second while turning)`);

  for (const [key, back] of [["w", "s"]]) {
    await page.keyboard.down(key);
    await page.waitForTimeout(400);
    await page.keyboard.up(key);
    check("keys fly", difference(turned, await p.picture()) > 1);
    await page.keyboard.down(back);
    await page.waitForTimeout(400);
    await page.keyboard.up(back);
  }

  const names = await page.evaluate(() => [...document.querySelectorAll("#layers button")].map((b) => b.dataset.layer));
  check("layers are those of a field", names.join() === "rgb,depth,normal,opacity,occupancy");
  const seen = {};
  for (const layer of names) {
    const n = await p.views();
    if (layer !== "rgb") {
      await p.layer(layer);
      await until(`layer ${layer}`, async () => (await p.views()) > n);
    }
    seen[layer] = await p.picture();
    const nearest = Math.min(...Object.entries(seen).filter(([k]) => k !== layer).map(([, p]) => difference(p, seen[layer])));
    if (layer !== "rgb") check(`layer ${layer} is another picture`, nearest > 2, `(mean difference ${nearest.toFixed(1)})`);
    await p.shot(layer);
  }
  await p.layer("rgb");
  // An axis of the gizmo.
  const shown = await p.picture();
  await page.focus("#gizmo g.z:not(.minus)");
  await page.keyboard.press("Enter");
  check("the corner's axes turn the camera", difference(shown, await p.picture()) > 3);
  await page.keyboard.press("h");
}

async function cropping(p) {
  const { page } = p;
  await p.card("crop");
  const whole = await p.picture();
  await page.evaluate(() => {
    const r = document.getElementById("crop-x0");
    r.value = String((Number(r.min) + 3 * Number(r.max)) / 4 > Number(document.getElementById("crop-x1").value)
      ? (Number(r.min) + Number(document.getElementById("crop-x1").value)) / 2 : (Number(r.min) + Number(r.max)) / 2);
    r.dispatchEvent(new Event("input"));
  });
  const cropped = await p.picture();
  check("the crop box changes the image", difference(whole, cropped) > 1, `(mean difference ${difference(whole, cropped).toFixed(1)})`);
  await p.shot("cropped");
  await page.click("#crop-save");
  await until("crop.json", () => existsSync(path.join(run, "crop.json")));
  const crop = JSON.parse(readFileSync(path.join(run, "crop.json")));
  const shownBox = await page.evaluate(() => [0, 1].map((end) => ["x", "y", "z"].map((axis) => Number(document.getElementById(`crop-${axis}${end}`).value))));
  const kept = [crop.min, crop.max].every((corner, end) => corner.every((v, k) => Math.abs(v - shownBox[end][k]) < 1e-4));
  check("the crop box is kept as it is shown", kept, `(${JSON.stringify(crop)})`);
}

async function filming(p) {
  const { page } = p;
  await p.card("path");
  await page.click("#key-add");
  await p.drag(150, 0, 8);
  await p.settled();
  await page.click("#key-add");
  await page.fill("#key-seconds", "0.5");
  await page.click("#path-save");
  const file = path.join(run, "camera_path.json");
  await until("camera_path.json", () => existsSync(file));
  const saved = JSON.parse(readFileSync(file));
  check("the camera path is kept", saved.keyframes.length === 2 && saved.camera_path.length === 12, `(${saved.camera_path.length} cameras)`);
  const [download] = await Promise.all([page.waitForEvent("download"), page.click("#path-download")]);
  await download.saveAs(path.join(scratch, "path.json"));
  check("the camera path is downloaded", JSON.parse(readFileSync(path.join(scratch, "path.json"))).keyframes.length === 2);
  const still = await p.views();
  await page.click("#key-play");
  await until("the path's preview", async () => (await p.views()) > still + 2);
  await page.click("#key-clear");
  check("without views the list says what to do", (await p.shown("#keys-empty")) && (await page.isDisabled("#key-play")));
  await page.setInputFiles("#path-open", file);
  await until("the keys of an opened path", async () => (await page.locator("#keys li").count()) === 2);
  check("a saved path is opened again", true);
}

/** Picks two points with a known distance; returns their distance in units of the capture. */
async function measuring(p) {
  const { page } = p;
  await p.card("measure");
  await p.settled();
  // Positions of two dark pixels far apart on the page: the object before the white background, not below floating panels.
  const [one, two] = await page.evaluate(() => {
    const c = document.getElementById("picture");
    const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    const box = c.getBoundingClientRect();
    const place = (i) => [box.left + ((i % c.width + 0.5) * box.width) / c.width, box.top + ((Math.floor(i / c.width) + 0.5) * box.height) / c.height];
    const dark = Array.from({ length: d.length / 4 }, (_, i) => i).filter((i) => i % 37 === 0 && d[4 * i] + d[4 * i + 1] + d[4 * i + 2] < 240)
      .filter((i) => document.elementFromPoint(...place(i))?.id === "overlay");
    dark.sort((a, b) => (a % c.width) - (b % c.width));
    return [dark[Math.floor(dark.length * 0.3)], dark[Math.floor(dark.length * 0.7)]].map(place);
  });
  await page.click("#measure");
  await page.mouse.click(...one);
  await until("the first point", async () => (await p.text("#measure-note")).includes("second"));
  await page.mouse.click(...two);
  await until("the second point", async () => (await p.text("#measure-note")).includes("units of the capture apart"));
  await page.fill("#measure-length", "25");
  await page.click("#measure-save");
  await until("scale.json", () => existsSync(path.join(run, "scale.json")));
  const scaled = JSON.parse(readFileSync(path.join(run, "scale.json")));
  const apart = Math.hypot(...scaled.points[0].map((v, k) => v - scaled.points[1][k]));
  check("a measured length is kept for export", scaled.metres === 0.25 && apart > 0.05 && apart < 2, `(${apart.toFixed(3)} units are 25 cm)`);
  await p.shot("measured");
  return apart;
}

async function exporting(p, apart) {
  const { page } = p;
  await p.card("export");
  await page.fill("#faces", "5000");
  await page.fill("#resolution", "64");
  await page.click("#export");
  check("a mesh in the making shows how far it is", (await p.shown("#export-progress")) && (await page.isDisabled("#export")));
  await until("a mesh in the page", async () => (await p.data("mesh")) === "shown");
  await p.settled();
  await p.shot("mesh");
  const glb = readFileSync(path.join(run, "mesh.glb"));
  check("a GLB is made and shown", glb.subarray(0, 4).toString() === "glTF" && (await page.isChecked("#mesh")), `(${glb.length >> 10} KiB)`);
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
  await download.saveAs(path.join(scratch, "s.png"));
  check("a screenshot is saved", readFileSync(path.join(scratch, "s.png")).subarray(1, 4).toString() === "PNG");
}

/** The page during training. */
async function live(browser) {
  const out = path.join(scratch, "live");
  const { address, stop } = await training(out);
  const p = await Page.open(browser, address);
  const step = async () => Number((await p.data("step")) ?? 0);
  const early = await until("a step", step);
  const seen = await p.views();
  const later = await until("later steps", async () => (await step()) > early + 20 && (await step()));
  await until("views without a touch", async () => (await p.views()) > seen + 2);
  await until("held-out pixels", async () => /\d+\.\d+ dB/.test(await p.text("dd[data-figure=val_psnr]").catch(() => "")));
  check("training shows held-out beside training PSNR, and how many views are behind fog", (await p.data("fog")) !== undefined);
  check("training shows its steps and views by itself", true, `(steps ${early} to ${later})`);
  const points = () => p.page.evaluate(() => document.querySelector("#charts polyline[data-figure=psnr]")?.getAttribute("points").split(" ").length ?? 0);
  const some = await points();
  await until("a longer curve", async () => (await points()) > some);
  check("training draws its curve and how much is done", (await p.shown("#training-progress")) && /^\d+ %$/.test(await p.text("#training-state")), `(${await points()} points, ${await p.text("#training-state")})`);
  await p.shot("training");
  await p.close();
  const code = await stop();
  check("Ctrl-C ends training and viewer with a checkpoint", code === 130 && existsSync(path.join(out, "checkpoints")), `(exit code ${code})`);
}

/** A data set and a file of splats, without a run. */
async function withoutRun(browser) {
  const cloud = path.join(scratch, "ball.ply");
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
    const p = await Page.open(browser, there.address);
    await p.settled();
    const pictures = await p.thumbnails(3);
    const colors = await p.page.evaluate(() => {
      const c = document.getElementById("picture");
      const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
      return new Set(Array.from({ length: d.length / 4 }, (_, i) => `${d[4 * i] >> 5} ${d[4 * i + 1] >> 5}`)).size;
    });
    check(`${name} is shown`, pictures && colors >= (what === cloud ? 8 : 1), `(${colors} colors)`);
    check(`${name} lists what points can show`, (await p.texts("#layers button")).join() === "Color,Depth,Opacity");
    check(`${name} says where there is nothing to see`, (await p.shown("#note")) === (what !== cloud));
    await p.shot(name);
    await p.close();
    await there.end();
  }
}

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"],
});
try {
  const { address } = await viewer(run);
  await guarded(browser, address);
  await shortcuts(browser, address);
  await themes(browser, address);
  await phone(browser, address);
  const p = await Page.open(browser, address);
  await looking(p);
  await cropping(p);
  await filming(p);
  await exporting(p, await measuring(p));
  await p.close();
  await ownLists(browser);
  await lostAndFailed(browser);
  await live(browser);
  await withoutRun(browser);
  const elsewhere = requests.filter(([r, own]) => !r.startsWith(new URL(own).origin) && !r.startsWith("blob:") && !r.startsWith("data:"));
  check("nothing is fetched from elsewhere", elsewhere.length === 0, elsewhere.join() || `(${requests.length} requests)`);
  check("the console has no errors", complaints.length === 0, complaints.join("; "));
  console.log(`${checked()} checks passed`);
} catch (e) {
  console.error(String(e));
  process.exitCode = 1;
} finally {
  await browser.close();
  await endAll();
  rmSync(scratch, { recursive: true, force: true });
}
