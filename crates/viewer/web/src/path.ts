// Keyframes and the smooth path through them; reads and writes nerfstudio's camera_path.json.

import * as THREE from "three";

export interface Key {
  matrix: THREE.Matrix4;
  fov: number;
}

export interface PathSettings {
  secondsPerView: number;
  fps: number;
  width: number;
  height: number;
  cycle: boolean;
}

/** The camera at `t` in 0..1 along the keyframes: Catmull-Rom for positions, spherical interpolation for rotations. */
export function at(keys: Key[], t: number, cycle: boolean): Key {
  const first = keys[0];
  if (!first || keys.length === 1) return first ?? { matrix: new THREE.Matrix4(), fov: 50 };
  const spans = cycle ? keys.length : keys.length - 1;
  const along = Math.min(Math.max(t, 0), 1) * spans;
  const i = Math.min(Math.floor(along), spans - 1);
  const s = along - i;
  const curve = new THREE.CatmullRomCurve3(keys.map((k) => new THREE.Vector3().setFromMatrixPosition(k.matrix)), cycle);
  const a = keys[i]!;
  const b = keys[(i + 1) % keys.length]!;
  const turn = new THREE.Quaternion().setFromRotationMatrix(a.matrix).slerp(new THREE.Quaternion().setFromRotationMatrix(b.matrix), s);
  const matrix = new THREE.Matrix4().compose(curve.getPoint(along / spans), turn, new THREE.Vector3(1, 1, 1));
  return { matrix, fov: a.fov + (b.fov - a.fov) * s };
}

export function seconds(keys: Key[], s: PathSettings): number {
  return Math.max(1, s.cycle ? keys.length : keys.length - 1) * s.secondsPerView;
}

export function toJson(keys: Key[], s: PathSettings): string {
  const aspect = s.width / s.height;
  const all = seconds(keys, s);
  const n = Math.max(1, Math.round(all * s.fps));
  const rows = (m: THREE.Matrix4) => m.clone().transpose().toArray();
  const views = Array.from({ length: n }, (_, i) => at(keys, s.cycle ? i / n : i / Math.max(n - 1, 1), s.cycle));
  return JSON.stringify({
    camera_type: "perspective",
    render_width: s.width,
    render_height: s.height,
    fps: s.fps,
    seconds: all,
    is_cycle: s.cycle,
    smoothness_value: 0.5,
    keyframes: keys.map((k) => ({ matrix: JSON.stringify(k.matrix.toArray()), fov: k.fov, aspect })),
    camera_path: views.map((v) => ({ camera_to_world: rows(v.matrix), fov: v.fov, aspect })),
  });
}

export function fromJson(text: string): { keys: Key[]; settings: PathSettings } {
  const j = JSON.parse(text);
  const numbers = (v: unknown): number[] => (typeof v === "string" ? JSON.parse(v) : v) as number[];
  let keys: Key[] = (j.keyframes ?? []).map((k: { matrix: unknown; fov?: number }) => ({
    matrix: new THREE.Matrix4().fromArray(numbers(k.matrix)),
    fov: k.fov ?? 50,
  }));
  const views: { camera_to_world: number[]; fov?: number }[] = j.camera_path ?? [];
  if (keys.length === 0) {
    // A path without keyframes: about a dozen of its cameras are used instead.
    const step = Math.max(1, Math.floor(views.length / 12));
    keys = views.filter((_, i) => i % step === 0).map((v) => ({
      matrix: new THREE.Matrix4().fromArray(v.camera_to_world).transpose(),
      fov: v.fov ?? 50,
    }));
  }
  const cycle = Boolean(j.is_cycle);
  const spans = Math.max(1, cycle ? keys.length : keys.length - 1);
  const fps = Number(j.fps) || 24;
  const all = Number(j.seconds) || views.length / fps || spans;
  const settings = { secondsPerView: all / spans, fps, width: Number(j.render_width) || 1280, height: Number(j.render_height) || 720, cycle };
  return { keys, settings };
}
