// Made from crates/viewer/src/messages.rs by its test; do not edit.

export type Layer = { id: string, label: string, legend: Legend | null, };
export type Legend = { "kind": "scale", colors: Array<string>, low: string, high: string, unit: string, } | { "kind": "classes", classes: Array<Class>, };
export type Class = { label: string, color: string, };
export type Control = { id: string, label: string, help: string, 
/**
 * Ids of the layers that it changes; empty: all layers.
 */
layers: Array<string>, input: Input, };
export type Input = { "kind": "slider", min: number, max: number, step: number, unit: string, default: number, } | { "kind": "toggle", default: boolean, } | { "kind": "pick", options: Array<Choice>, default: string, };
export type Choice = { id: string, label: string, };
export type Figure = { id: string, label: string, value: number, text: string, };
export type Line = { 
/**
 * Id of the figure.
 */
figure: string, label: string, 
/**
 * Of data that was held out: few values, each shown as a dot.
 */
held_out: boolean, points: Array<[number, number]>, };
export type Chart = { label: string, unit: string, lines: Array<Line>, };
export type Value = number | boolean | string;
export type View = { width: number, height: number, fov_y: number, pose: [number, number, number, number, number, number, number, number, number, number, number, number], layer: string, 
/**
 * Values of controls by id; controls that are left out have their defaults.
 */
values: { [key in string]: Value }, clip: [number, number, number, number, number, number] | null, };
export type ClientMessage = { "kind": "view", id: number, view: View, } | { "kind": "pick", x: number, y: number, view: View, } | { "kind": "measured", points: [number, number, number, number, number, number] | null, metres: number, } | { "kind": "thumbnail", frame: number, } | { "kind": "crop", clip: [number, number, number, number, number, number] | null, } | { "kind": "path", json: string, } | { "kind": "open_path", json: string, } | { "kind": "export", format: string, faces: number, resolution: number, clip: [number, number, number, number, number, number] | null, };
export type Photograph = { name: string, pose: [number, number, number, number, number, number, number, number, number, number, number, number], fov_y: number, aspect: number, held_out: boolean, };
export type ServerMessage = { "kind": "scene", name: string, photographs: Array<Photograph>, layers: Array<Layer>, controls: Array<Control>, 
/**
 * One line about what can be shown and what cannot; may be empty.
 */
note: string, 
/**
 * Whether boxes, lengths and paths can be saved and meshes exported.
 */
is_run: boolean, focus: [number, number, number], distance: number, 
/**
 * Rows of the similarity from the capture's frame to the world.
 */
world_from_capture: [number, number, number, number, number, number, number, number, number, number, number, number], bounds: [number, number, number, number, number, number], crop: [number, number, number, number, number, number] | null, 
/**
 * Two points of the world, and the meters between them.
 */
measured: [number, number, number, number, number, number, number] | null, path: string | null, } | { "kind": "picked", point: [number, number, number] | null, } | { "kind": "status", step: number, seconds: number, 
/**
 * Completed share of the training, 0 to 1.
 */
progress: number, running: boolean, figures: Array<Figure>, } | { "kind": "history", charts: Array<Chart>, } | { "kind": "fog", frames: Array<number>, } | { "kind": "working", what: string, percent: number, } | { "kind": "exported", file: string, glb: boolean, 
/**
 * Meters of the mesh per unit of the capture.
 */
scale: number, } | { "kind": "path", json: string, } | { "kind": "saved", what: string, file: string, } | { "kind": "failed", why: string, 
/**
 * The id of the view that could not be rendered, if the failure concerns a view.
 */
view: number | null, };
