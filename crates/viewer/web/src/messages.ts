// Made from crates/viewer/src/messages.rs by its test; do not edit.

export type Layer = "rgb" | "depth" | "normal" | "opacity" | "occupancy";
export type Ask = { "kind": "view", id: number, width: number, height: number, fov_y: number, pose: [number, number, number, number, number, number, number, number, number, number, number, number], layer: Layer, clip: [number, number, number, number, number, number] | null, } | { "kind": "pick", x: number, y: number, width: number, height: number, fov_y: number, pose: [number, number, number, number, number, number, number, number, number, number, number, number], clip: [number, number, number, number, number, number] | null, } | { "kind": "measured", points: [number, number, number, number, number, number] | null, metres: number, } | { "kind": "thumbnail", frame: number, } | { "kind": "crop", clip: [number, number, number, number, number, number] | null, } | { "kind": "path", json: string, } | { "kind": "open_path", json: string, } | { "kind": "export", format: string, faces: number, resolution: number, clip: [number, number, number, number, number, number] | null, };
export type Photograph = { name: string, pose: [number, number, number, number, number, number, number, number, number, number, number, number], fov_y: number, aspect: number, held_out: boolean, };
export type Tell = { "kind": "scene", name: string, photographs: Array<Photograph>, focus: [number, number, number], distance: number, 
/**
 * Rows of the similarity that takes meshes to the world.
 */
world_from_capture: [number, number, number, number, number, number, number, number, number, number, number, number], bounds: [number, number, number, number, number, number], crop: [number, number, number, number, number, number] | null, 
/**
 * Two points of the world, and the metres between them.
 */
measured: [number, number, number, number, number, number, number] | null, path: string | null, } | { "kind": "picked", point: [number, number, number] | null, } | { "kind": "status", step: number, seconds: number, loss: number, psnr: number, 
/**
 * Of held-out pixels.
 */
held_out: number | null, rays_per_s: number, running: boolean, } | { "kind": "fog", frames: Array<number>, } | { "kind": "working", what: string, percent: number, } | { "kind": "exported", file: string, glb: boolean, 
/**
 * Metres of the mesh per unit of the capture.
 */
scale: number, } | { "kind": "path", json: string, } | { "kind": "saved", what: string, file: string, } | { "kind": "failed", why: string, };
