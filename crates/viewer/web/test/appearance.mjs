// Checks of the page's appearance and use: shortcuts, themes, lists of a source, a lost connection, small screens.

import { Page, check, difference, run, standIn, until, viewer } from "./driver.mjs";

/** Shortcuts, the help that lists them, and stored settings. */
export async function shortcuts(browser, address) {
  const p = await Page.open(browser, address);
  const { page } = p;
  await p.settled();
  await page.keyboard.press("?");
  const rows = await page.locator("#help dt").count();
  check("? shows the shortcuts", (await p.shown("#help")) && rows >= 20, `(${rows} of them)`);
  await p.shot("help");
  await page.keyboard.press("b");
  check("under the help no shortcut works", !(await page.isChecked("#crop")));
  await page.keyboard.press("Escape");
  check("Escape closes the help", !(await p.shown("#help")));
  await page.keyboard.press("2");
  check("a number chooses a layer", (await p.data("layer")) === "depth" && (await p.shown("#legend")), `(${(await p.text("#legend")).replaceAll("\n", " ")})`);
  await page.keyboard.press("1");
  check("a layer without legend shows none", !(await p.shown("#legend")));
  await page.keyboard.press("c");
  check("C hides the cameras", !(await page.isChecked("#frusta")));
  await page.keyboard.press("b");
  check("B crops and opens the card", (await page.isChecked("#crop")) && (await p.shown("#crop-sides")));
  await page.keyboard.press("b");
  await page.keyboard.press("m");
  await page.keyboard.press("Escape");
  check("M picks and Escape stops", (await p.shown("#measure-note")) && !(await page.evaluate(() => document.body.classList.contains("picking"))));
  await page.click("#key-add", { timeout: 500 }).then(() => { throw new Error("a folded card's button was clicked"); }, () => {});
  await page.keyboard.press("k");
  check("K adds a view to the path", (await page.locator("#keys li").count()) === 1);
  const first = await p.picture();
  await page.keyboard.press("]");
  check("] goes to the next photograph", difference(first, await p.picture()) > 2 && (await page.getAttribute("#photographs [data-frame='1']", "aria-pressed")) === "true");
  await p.drag(60, 0, 4);
  check("a photograph that the camera leaves is not marked", (await page.locator("#photographs [aria-pressed=true]").count()) === 0);
  await page.keyboard.press("h");
  const home = difference(first, await p.picture());
  check("H goes home", home < 1, `(mean difference ${home.toFixed(2)})`);
  await page.fill("#key-seconds", "3");
  await page.focus("#key-seconds");
  await page.keyboard.type("2");
  check("keys in a field are text", (await page.inputValue("#key-seconds")).includes("32") && (await p.data("layer")) === "rgb");
  await page.keyboard.press("Tab");
  await page.evaluate(() => document.activeElement.blur());
  await page.keyboard.press("n");
  await page.keyboard.press("l");
  check("N and L clear the stage", !(await p.shown("#panel")) && !(await p.shown("#photographs")));
  await page.reload();
  await until("a view", async () => (await p.views()) > 0);
  check("hidden panels stay hidden", !(await p.shown("#panel")) && !(await p.shown("#photographs")));
  await p.close();
}

/** Dark and light theme, names for screen readers, and no layout shift. */
export async function themes(browser, address) {
  const p = await Page.open(browser, address);
  const { page } = p;
  const bright = () => page.evaluate(() => {
    const probe = document.createElement("i");
    probe.style.color = "var(--page)";
    document.body.append(probe);
    const [r, g, b] = getComputedStyle(probe).color.match(/[\d.]+/g).map(Number);
    probe.remove();
    return (r + g + b) / 3 > 128;
  });
  const asSystem = [await bright()];
  await page.emulateMedia({ colorScheme: "light" });
  asSystem.push(await bright());
  check("the theme follows the system", !asSystem[0] && asSystem[1]);
  await page.keyboard.press("t");
  await page.emulateMedia({ colorScheme: "dark" });
  check("light when light is chosen", await bright());
  await page.click("#theme");
  await page.emulateMedia({ colorScheme: "light" });
  check("dark when dark is chosen", !(await bright()) && (await page.getAttribute("#theme", "aria-label")) === "Theme: dark");
  await page.reload();
  check("the chosen theme stays", !(await bright()));
  const unnamed = await page.evaluate(() => [...document.querySelectorAll("button, input:not([type=file]), select, [role=button]")]
    .filter((e) => !(e.textContent.trim() || e.getAttribute("aria-label") || e.labels?.length || e.querySelector("img[alt]"))).map((e) => e.outerHTML));
  check("everything to press has a name", unnamed.length === 0, unnamed.join(" "));
  const shift = await page.evaluate(() => new Promise((r) => {
    new PerformanceObserver((l) => r(l.getEntries().reduce((s, e) => s + e.value, 0))).observe({ type: "layout-shift", buffered: true });
    setTimeout(() => r(0), 500);
  }));
  check("nothing jumps while the page loads", shift < 0.05, `(layout shift ${shift.toFixed(4)})`);
  await p.close();
}

/** Layers and controls that only one source has. */
export async function ownLists(browser) {
  const { address, end } = await standIn();
  const p = await Page.open(browser, address);
  const { page } = p;
  check("layers are those that the source lists", (await p.texts("#layers button")).join() === "Shaded,Albedo,Height");
  const shaded = await p.picture();
  await page.focus("#control-sun");
  for (let i = 0; i < 30; i++) await page.keyboard.press("ArrowRight");
  check("a slider has its range and unit", (await p.text("[data-control=sun] output")) === "70°" && (await page.getAttribute("#control-sun", "max")) === "90");
  const noon = await p.picture();
  check("a slider changes the picture", difference(shaded, noon) > 2, `(mean difference ${difference(shaded, noon).toFixed(1)})`);
  await page.click("[data-control=sun] .reset");
  check("a control goes back to its default", (await p.text("[data-control=sun] output")) === "40°" && difference(shaded, await p.picture()) < 0.5);
  await p.layer("albedo");
  check("the legend names what colors stand for", (await p.text("#legend")).includes("warm paint"), `(${(await p.text("#legend")).replaceAll("\n", " ")})`);
  check("controls of other layers are hidden", !(await p.shown("#control-sun")) && (await p.shown("#control-pattern")));
  const stripes = await p.picture();
  check("layer albedo is another picture", difference(shaded, stripes) > 5);
  await page.selectOption("#control-pattern", "checker");
  const checker = await p.picture();
  check("a pick changes the picture", difference(stripes, checker) > 5);
  await page.check("#control-sky");
  check("a toggle changes the picture", difference(checker, await p.picture()) > 5);
  await p.shot("own lists");
  await p.layer("height");
  check("a scale shows its unit", (await p.text("#legend")).includes("1 m"));
  check("what only a run can do is not offered", !(await p.shown("#card-export")) && !(await p.shown("#card-training")) && !(await p.shown("#crop-save")));
  await p.close();
  await end();
}

/** A program that ends and starts again, and views that cannot be rendered. */
export async function lostAndFailed(browser) {
  const first = await viewer(run);
  const port = new URL(first.address).port;
  const p = await Page.open(browser, first.address, { mayComplain: true });
  await p.layer("depth");
  await p.drag(120, 0, 6);
  const before = await p.picture();
  await first.end();
  await until("the banner", () => p.shown("#banner"));
  check("a program that has ended is reported", /ended|respond/.test(await p.text("#banner")), `(${await p.text("#banner-text")})`);
  await p.shot("gone");
  const views = await p.views();
  const second = await viewer(run, port);
  await p.page.click("#retry").catch(() => {});
  await until("the connection", async () => !(await p.shown("#banner")));
  await until("a view again", async () => (await p.views()) > views);
  const again = difference(before, await p.picture());
  check("the page connects again and stays where it was", (await p.data("layer")) === "depth" && again < 1, `(mean difference ${again.toFixed(2)})`);
  await p.close();

  let fail = false;
  const q = await Page.open(browser, second.address, {
    route: (ws) => {
      const server = ws.connectToServer();
      server.onMessage((m) => {
        if (typeof m === "string" || !fail) return ws.send(m);
        ws.send(JSON.stringify({ kind: "failed", why: "the device has no memory left", view: Buffer.from(m).readUInt32LE(0) }));
      });
    },
  });
  await q.settled();
  fail = true;
  await q.layer("normal");
  await until("the failure", () => q.shown("#empty"));
  check("a view that cannot be drawn says why", (await q.text("#empty")).includes("no memory left"));
  await q.shot("failed");
  fail = false;
  await q.layer("rgb");
  await until("the picture again", async () => !(await q.shown("#empty")));
  check("the next view is asked for", true);
  await q.close();
  await second.end();
}

/** A phone in portrait orientation: the sheet, its tabs, and touch. */
export async function phone(browser, address) {
  const options = { viewport: { width: 390, height: 844 }, isMobile: true, hasTouch: true };
  const p = await Page.open(browser, address, { options });
  const { page } = p;
  const stage = () => page.evaluate(() => document.getElementById("stage").clientHeight);
  const whole = await stage();
  await p.settled();
  await p.shot("phone");
  check("a phone has tabs and no panel", (await p.shown("#tabs")) && !(await p.shown("#layers")) && whole > 700, `(stage ${whole} px)`);
  await page.tap("#tabs [data-tab=view]");
  await until("the sheet", async () => (await stage()) < whole - 200);
  check("a tab opens the sheet", (await p.shown("#layers")) && !(await p.shown("#crop-sides")));
  await p.layer("opacity");
  check("a layer is chosen by touch", (await p.data("layer")) === "opacity");
  await p.layer("rgb");
  await page.tap("#tabs [data-tab=crop]");
  check("another tab shows another card", (await p.shown("#crop-sides")) && !(await p.shown("#layers")));
  await page.tap("#tabs [data-tab=photos]");
  check("photographs are a tab", (await p.thumbnails(8)) && (await p.shown("#photographs")));
  const outside = await page.evaluate(() => [...document.querySelectorAll("body *")].filter((e) => e.checkVisibility() && e.getBoundingClientRect().right > 391).map((e) => e.id || e.className));
  check("nothing sticks out at the side", outside.length === 0, outside.join());
  await p.shot("phone photographs");
  await page.tap("#tabs [data-tab=photos]");
  await until("the folded sheet", async () => (await stage()) === whole);

  const touch = await page.context().newCDPSession(page);
  const fingers = async (from, to) => {
    const points = (t) => from.map(([x, y], i) => ({ x: x + (to[i][0] - x) * t, y: y + (to[i][1] - y) * t, id: i }));
    await touch.send("Input.dispatchTouchEvent", { type: "touchStart", touchPoints: points(0) });
    for (let i = 1; i <= 10; i++) await touch.send("Input.dispatchTouchEvent", { type: "touchMove", touchPoints: points(i / 10) });
    await touch.send("Input.dispatchTouchEvent", { type: "touchEnd", touchPoints: [] });
  };
  const before = await p.picture();
  await fingers([[200, 350]], [[290, 350]]);
  const turned = await p.picture();
  check("a finger turns", difference(before, turned) > 3, `(mean difference ${difference(before, turned).toFixed(1)})`);
  await fingers([[180, 350], [220, 350]], [[90, 350], [310, 350]]);
  const nearer = await p.picture();
  check("a pinch comes nearer", difference(turned, nearer) > 3, `(mean difference ${difference(turned, nearer).toFixed(1)})`);
  await p.close();
}
