// Helpers for elements of the page, new elements, and settings stored in the browser.

/** The element with an id of `index.html`. */
export function element<T extends Element = HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`index.html has no #${id}`);
  return found as unknown as T;
}

export const input = (id: string): HTMLInputElement => element<HTMLInputElement>(id);

export const select = (id: string): HTMLSelectElement => element<HTMLSelectElement>(id);

export function onClick(id: string, act: () => void): void {
  element(id).addEventListener("click", act);
}

/** A new element with properties and children. */
export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Partial<HTMLElementTagNameMap[K]> = {},
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

const SVG = "http://www.w3.org/2000/svg";

export function svg(tag: string, attributes: Record<string, string | number>): SVGElement {
  const made = document.createElementNS(SVG, tag);
  for (const [k, v] of Object.entries(attributes)) made.setAttribute(k, String(v));
  return made;
}

/** An icon of the sprite in `index.html`. */
export function icon(name: string): SVGElement {
  const made = svg("svg", { class: "icon", "aria-hidden": "true" });
  made.append(svg("use", { href: `#i-${name}` }));
  return made;
}

/** A button with only an icon; `label` is its tooltip and its name for screen readers. */
export function iconButton(name: string, label: string, act: () => void): HTMLButtonElement {
  const b = make("button", { className: "quiet", title: label, type: "button" }, icon(name));
  b.setAttribute("aria-label", label);
  b.addEventListener("click", act);
  return b;
}

export function download(name: string, href: string): void {
  make("a", { href, download: name }).click();
}

/** Settings that the browser stores between visits, if it is allowed to. */
export const memory = {
  get(key: string): string | null {
    try {
      return localStorage.getItem(`diorama.${key}`);
    } catch {
      return null;
    }
  },
  set(key: string, value: string): void {
    try {
      localStorage.setItem(`diorama.${key}`, value);
    } catch {
      // Private windows may refuse; the page works without stored settings.
    }
  },
};
