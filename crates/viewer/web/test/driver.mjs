// Helpers for the checks of the page: programs to view, browser pages, and comparison of pictures.

import { spawn } from "node:child_process";
import net from "node:net";
import path from "node:path";

export const [diorama, run, pictures] = process.argv.slice(2);
const ownPicture = path.join(path.dirname(diorama), "examples", "own_picture");

/** Seconds that a busy machine may take for anything that a check waits for. */
const patience = 240;

/** Waits until `f` returns something. */
export const until = async (what, f, seconds = patience) => {
  for (const end = Date.now() + seconds * 1000; Date.now() < end; await new Promise((r) => setTimeout(r, 50))) {
    const v = await f();
    if (v) return v;
  }
  throw new Error(`waited ${seconds} s for ${what}`);
};

let checks = 0;
export const checked = () => checks;
export const check = (what, ok, detail = "") => {
  if (!ok) throw new Error(`FAILED: ${what} ${detail}`);
  checks += 1;
  console.log(`ok  ${what} ${detail}`);
};

/** Functions that end the programs that are still running. */
const ends = new Set();
export const endAll = () => Promise.all([...ends].map((e) => e()));

async function listening(program, args) {
  const child = spawn(program, args, { stdio: ["ignore", "pipe", "inherit"] });
  const gone = new Promise((r) => child.on("exit", r));
  const end = () => (ends.delete(end), child.kill("SIGINT"), setTimeout(() => child.kill("SIGKILL"), 20000).unref(), gone);
  ends.add(end);
  let out = "";
  child.stdout.on("data", (d) => (out += d));
  return { address: await until("the viewer's address", () => out.match(/http:\/\/[^"\s]+/)?.[0]), end };
}

/** Starts a viewer; returns its address and a function that ends it. */
export const viewer = (what, port = 0, ...flags) => listening(diorama, ["view", what, "--port", String(port), "--json", "--device", "cpu", ...flags]);

/** Starts the example source of `crates/viewer/examples`. */
export const standIn = () => listening(ownPicture, []);

/** Starts training with a viewer on the capture of the run, longer than any check takes; returns its address and a function that stops it. */
export async function training(out) {
  const flags = ["--steps", "100000", "--view", "--port", "0", "--device", "cpu", "--set", "field.log2_size=15"];
  const child = spawn(diorama, ["train", path.join(run, "capture"), "-o", out, ...flags], { stdio: ["ignore", "ignore", "pipe"] });
  let said = "";
  child.stderr.on("data", (d) => (said += d));
  const ended = new Promise((r) => child.on("exit", r));
  const stop = () => (ends.delete(stop), child.kill("SIGINT"), setTimeout(() => child.kill("SIGKILL"), 1000 * patience).unref(), ended);
  ends.add(stop);
  return { address: await until("the address", () => said.match(/view: (http\S+)/)?.[1]), stop };
}

/** Sends a raw request; returns the status of the answer. */
export function raw(port, lines, host = "127.0.0.1") {
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

/** Console errors of all pages, and the requests that pages made. */
export const complaints = [];
export const requests = [];

/** The viewer's page in a browser. */
export class Page {
  static async open(browser, address, { options = {}, mayComplain = false, route } = {}) {
    const context = await browser.newContext({ viewport: { width: 1000, height: 700 }, colorScheme: "dark", ...options });
    context.setDefaultTimeout(1000 * patience);
    const page = await context.newPage();
    if (!mayComplain) page.on("console", (m) => m.type() === "error" && complaints.push(m.text()));
    page.on("pageerror", (e) => complaints.push(String(e)));
    page.on("request", (r) => requests.push([r.url(), address]));
    if (route) await page.routeWebSocket(/socket/, route);
    await page.goto(address);
    const made = new Page(page);
    await until("a view", async () => (await made.views()) > 0);
    return made;
  }

  constructor(page) {
    this.page = page;
  }

  close = () => this.page.context().close();
  data = (name) => this.page.evaluate((n) => document.body.dataset[n], name);
  views = async () => Number((await this.data("views")) ?? 0);
  shown = (selector) => this.page.locator(selector).first().isVisible();
  texts = (selector) => this.page.locator(selector).allInnerTexts();
  text = (selector) => this.page.locator(selector).first().innerText();
  /** Opens a card of the panel. */
  card = (name) => this.page.evaluate((n) => (document.getElementById(`card-${n}`).open = true), name);
  shot = async (name) => pictures && (await this.page.screenshot({ path: path.join(pictures, `${name}.png`) }));

  /** Waits until a view at full resolution is shown and nothing moves. */
  async settled() {
    for (let before = -1, now = 0; before !== now; ) {
      await this.page.waitForTimeout(150);
      await until("a whole view", async () => (await this.data("settled")) === "true");
      [before, now] = [now, await this.views()];
    }
  }

  /** The picture, reduced. */
  async picture() {
    await this.settled();
    return this.page.evaluate(() => {
      const small = document.createElement("canvas");
      [small.width, small.height] = [64, 48];
      const g = small.getContext("2d");
      g.drawImage(document.getElementById("picture"), 0, 0, 64, 48);
      return [...g.getImageData(0, 0, 64, 48).data].filter((_, i) => i % 4 < 3);
    });
  }

  /** Chooses a layer by its button. */
  layer = (id) => this.page.click(`#layers [data-layer=${id}]`);

  /** Drags with the mouse from the center of the stage. */
  async drag(dx, dy, steps, wait = 0) {
    const [x, y] = await this.middle();
    await this.page.mouse.move(x, y);
    await this.page.mouse.down();
    for (let i = 1; i <= steps; i++) {
      await this.page.mouse.move(x + (dx * i) / steps, y + (dy * i) / steps);
      if (wait) await this.page.waitForTimeout(wait);
    }
    await this.page.mouse.up();
  }

  async middle() {
    const box = await this.page.locator("#overlay").boundingBox();
    return [box.x + box.width / 2, box.y + box.height / 2];
  }

  /** Waits until more than `some` thumbnails are loaded. */
  thumbnails = (some) => until("thumbnails", () => this.page.evaluate((n) => [...document.querySelectorAll("#photographs img")].filter((i) => i.naturalWidth > 0).length > n, some));
}

export const difference = (a, b) => a.reduce((s, v, i) => s + Math.abs(v - b[i]), 0) / a.length;
