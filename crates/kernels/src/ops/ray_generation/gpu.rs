//! One unit per ray; lenses are inverted by Newton's method in f32.

use super::{CORRECTION, PosedCamera};
use crate::gpu::{Accumulate, Buffer, Gpu, launch};
use cubecl::prelude::*;
use diorama_geom::Lens;
use std::f32::consts::{PI, TAU};

/// Numbers per camera: rotation and translation `[3, 4]`, fx, fy, cx, cy, width, height, lens, its ten numbers.
pub(crate) const CAMERA: usize = 29;
pub(crate) const INTRINSICS: usize = 12;
const LENS: usize = 18;

const PINHOLE: u32 = 0;
const BROWN: u32 = 1;
const FISHEYE: u32 = 2;
const FOV: u32 = 3;
const EQUIRECTANGULAR: u32 = 4;

/// Cameras on the device.
pub struct GpuCameras {
    count: usize,
    /// Cameras without corrections.
    base: Buffer,
    /// Cameras with their corrections.
    pub(crate) numbers: Buffer,
}

impl GpuCameras {
    pub fn upload(gpu: &Gpu, cameras: &[PosedCamera]) -> Self {
        let mut numbers: Vec<f64> = Vec::with_capacity(cameras.len() * CAMERA);
        for c in cameras {
            let (r, t, k) = (c.pose.rotation, c.pose.translation, &c.camera);
            for i in 0..3 {
                numbers.extend([r.x_axis[i], r.y_axis[i], r.z_axis[i], t[i]]);
            }
            numbers.extend([k.fx, k.fy, k.cx, k.cy, k.width as f64, k.height as f64]);
            let (lens, own) = match k.lens {
                Lens::Pinhole => (PINHOLE, vec![]),
                Lens::Brown { k, p } => (BROWN, [&k[..], &p].concat()),
                Lens::Fisheye { k, p, s } => (FISHEYE, [&k[..], &p, &s].concat()),
                Lens::Fov { omega } => (FOV, vec![omega]),
                Lens::Equirectangular => (EQUIRECTANGULAR, vec![]),
            };
            numbers.push(lens as f64);
            numbers.extend((0..10).map(|i| own.get(i).copied().unwrap_or(0.0)));
        }
        let numbers: Vec<f32> = numbers.into_iter().map(|v| v as f32).collect();
        GpuCameras { count: cameras.len(), base: gpu.upload(&numbers), numbers: gpu.upload(&numbers) }
    }

    /// Applies corrections `[cameras, 7]` to the cameras as they were given; see [`PosedCamera::corrected`]. Unless
    /// focal lengths are `refined`, their corrections are reset to 0.
    pub fn correct(&self, gpu: &Gpu, corrections: &Buffer, refined: bool) {
        assert_eq!(corrections.len(), self.count * CORRECTION, "cameras: corrections");
        let n = self.count;
        launch!(
            gpu,
            adjust,
            n,
            [self.base => n * CAMERA, corrections => n * CORRECTION, self.numbers => n * CAMERA],
            n as u32,
            refined,
        );
    }

    /// Origins and unit directions `[R, 3]` of the rays through `pixels` `[R, 2]` of cameras `index` `[R]`.
    pub fn forward(&self, gpu: &Gpu, index: &Buffer<u32>, pixels: &Buffer) -> (Buffer, Buffer) {
        let n = index.len();
        let (origins, dirs) = (gpu.empty(n * 3), gpu.empty(n * 3));
        launch!(
            gpu,
            cast,
            n,
            [self.numbers => self.count * CAMERA, index => n, pixels => n * 2, origins => n * 3, dirs => n * 3],
            n as u32,
        );
        (origins, dirs)
    }

    /// Gradient of the corrections `[cameras, 7]` at zero.
    pub fn backward(&self, gpu: &Gpu, index: &Buffer<u32>, pixels: &Buffer, dirs: &Buffer, d_origins: &Buffer, d_dirs: &Buffer) -> Buffer {
        let (n, out) = (index.len(), gpu.zeros(self.count * CORRECTION));
        launch!(
            gpu,
            correct::<Adder>,
            n,
            [
                self.numbers => self.count * CAMERA,
                index => n,
                pixels => n * 2,
                dirs => n * 3,
                d_origins => n * 3,
                d_dirs => n * 3,
                out => self.count * CORRECTION,
            ],
            n as u32,
        );
        out
    }
}

/// A camera rotated by a rotation vector (Rodrigues' formula), translated, and with its focal lengths scaled.
#[cube(launch_unchecked)]
fn adjust(base: &[f32], corrections: &mut [f32], out: &mut [f32], n: u32, #[comptime] refined: bool) {
    let camera = ABSOLUTE_POS;
    if camera >= n as usize {
        terminate!();
    }
    let at = camera * CAMERA;
    let d = camera * CORRECTION;
    let x = corrections[d + 3];
    let y = corrections[d + 4];
    let z = corrections[d + 5];
    let angle = (x * x + y * y + z * z).sqrt();
    // sin a / a and (1 − cos a) / a².
    let mut s = 1.0f32;
    let mut c = 0.5f32;
    if angle > 1e-4 {
        s = angle.sin() / angle;
        let half = (0.5 * angle).sin() / angle;
        c = 2.0 * half * half;
    }
    #[unroll]
    for col in 0..3usize {
        let vx = base[at + col];
        let vy = base[at + 4 + col];
        let vz = base[at + 8 + col];
        // v + s (a × v) + c a × (a × v)
        let cx = y * vz - z * vy;
        let cy = z * vx - x * vz;
        let cz = x * vy - y * vx;
        out[at + col] = vx + s * cx + c * (y * cz - z * cy);
        out[at + 4 + col] = vy + s * cy + c * (z * cx - x * cz);
        out[at + 8 + col] = vz + s * cz + c * (x * cy - y * cx);
    }
    #[unroll]
    for k in 0..3usize {
        out[at + k * 4 + 3] = base[at + k * 4 + 3] + corrections[d + k];
    }
    if comptime!(!refined) {
        corrections[d + 6] = 0.0;
    }
    let scale = corrections[d + 6].exp();
    out[at + 12] = base[at + 12] * scale;
    out[at + 13] = base[at + 13] * scale;
    // The numbers that corrections do not change.
    #[unroll]
    for k in 14..CAMERA {
        let same = base[at + k];
        out[at + k] = same;
    }
}

#[derive(CubeType)]
struct Point {
    x: f32,
    y: f32,
}

#[derive(CubeType)]
pub(crate) struct Direction {
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

/// Ideal to distorted coordinates of the lens whose numbers begin at `at`.
#[cube]
fn distort(c: &[f32], at: usize, x: f32, y: f32) -> Point {
    let r2 = x * x + y * y;
    let mut radial = 1.0 + r2 * (c[at + 1] + r2 * (c[at + 2] + r2 * (c[at + 3] + r2 * c[at + 4])));
    let mut p0 = c[at + 5];
    let mut p1 = c[at + 6];
    let mut s0 = c[at + 7];
    let mut s1 = c[at + 8];
    if u32::cast_from(c[at]) == BROWN {
        let above = 1.0 + r2 * (c[at + 1] + r2 * (c[at + 2] + r2 * c[at + 3]));
        radial = above / (1.0 + r2 * (c[at + 4] + r2 * (c[at + 5] + r2 * c[at + 6])));
        p0 = c[at + 7];
        p1 = c[at + 8];
        s0 = 0.0;
        s1 = 0.0;
    }
    Point {
        x: x * radial + 2.0 * p0 * x * y + p1 * (r2 + 2.0 * x * x) + s0 * r2,
        y: y * radial + 2.0 * p1 * x * y + p0 * (r2 + 2.0 * y * y) + s1 * r2,
    }
}

/// Inverse of [`distort`].
#[cube]
fn undistort(c: &[f32], at: usize, x: f32, y: f32) -> Point {
    let mut u = x;
    let mut v = y;
    let h = 4e-3f32;
    for _ in 0..10u32 {
        let e = distort(c, at, u, v);
        let right = distort(c, at, u + h, v);
        let left = distort(c, at, u - h, v);
        let down = distort(c, at, u, v + h);
        let up = distort(c, at, u, v - h);
        let xx = (right.x - left.x) / (2.0 * h);
        let yx = (right.y - left.y) / (2.0 * h);
        let xy = (down.x - up.x) / (2.0 * h);
        let yy = (down.y - up.y) / (2.0 * h);
        let det = xx * yy - xy * yx;
        if det.abs() > 1e-12 {
            let ex = e.x - x;
            let ey = e.y - y;
            u -= (yy * ex - xy * ey) / det;
            v -= (xx * ey - yx * ex) / det;
        }
    }
    Point { x: u, y: v }
}

/// Unit direction in the camera of the ray through a pixel, with focal lengths scaled.
#[cube]
pub(crate) fn direction(c: &[f32], camera: usize, px: f32, py: f32, zoom: f32) -> Direction {
    let k = camera * CAMERA + INTRINSICS;
    let at = camera * CAMERA + LENS;
    let lens = u32::cast_from(c[at]);
    let mut x = (px - c[k + 2]) / (c[k] * zoom);
    let mut y = (py - c[k + 3]) / (c[k + 1] * zoom);
    let mut z = 1.0f32;
    if lens == BROWN || lens == FISHEYE {
        let ideal = undistort(c, at, x, y);
        x = ideal.x;
        y = ideal.y;
    }
    if lens == FISHEYE {
        let theta = (x * x + y * y).sqrt();
        if theta > 1e-6 {
            x *= theta.sin() / theta;
            y *= theta.sin() / theta;
        }
        z = theta.cos();
    }
    if lens == FOV {
        let r = (x * x + y * y).sqrt();
        let omega = c[at + 1];
        if r > 1e-6 && omega > 1e-6 {
            let s = (r * omega).tan() / (2.0 * r * (0.5 * omega).tan());
            x *= s;
            y *= s;
        }
    }
    if lens == EQUIRECTANGULAR {
        let lon = (px / c[k + 4] - 0.5) * TAU;
        let lat = (py / c[k + 5] - 0.5) * PI;
        x = lon.sin() * lat.cos();
        y = lat.sin();
        z = lon.cos() * lat.cos();
    }
    let scale = 1.0 / (x * x + y * y + z * z).sqrt();
    Direction { x: x * scale, y: y * scale, z: z * scale }
}

/// Rotates a direction from the camera into the world.
#[cube]
pub(crate) fn rotate_to_world(c: &[f32], camera: usize, d: &Direction) -> Direction {
    let r = camera * CAMERA;
    Direction {
        x: c[r] * d.x + c[r + 1] * d.y + c[r + 2] * d.z,
        y: c[r + 4] * d.x + c[r + 5] * d.y + c[r + 6] * d.z,
        z: c[r + 8] * d.x + c[r + 9] * d.y + c[r + 10] * d.z,
    }
}

#[cube(launch_unchecked)]
fn cast(c: &[f32], index: &[u32], pixels: &[f32], origins: &mut [f32], dirs: &mut [f32], n: u32) {
    let r = ABSOLUTE_POS;
    if r >= n as usize {
        terminate!();
    }
    let camera = index[r] as usize;
    let local = direction(c, camera, pixels[r * 2], pixels[r * 2 + 1], 1.0);
    let d = rotate_to_world(c, camera, &local);
    #[unroll]
    for k in 0..3usize {
        origins[r * 3 + k] = c[camera * CAMERA + k * 4 + 3];
    }
    dirs[r * 3] = d.x;
    dirs[r * 3 + 1] = d.y;
    dirs[r * 3 + 2] = d.z;
}

#[cube(launch_unchecked)]
fn correct<A: Accumulate>(
    c: &[f32],
    index: &[u32],
    pixels: &[f32],
    dirs: &[f32],
    d_origins: &[f32],
    d_dirs: &[f32],
    out: &[Atomic<A::Cell>],
    n: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= n as usize {
        terminate!();
    }
    let camera = index[r] as usize;
    let to = camera * CORRECTION;
    let gx = d_dirs[r * 3];
    let gy = d_dirs[r * 3 + 1];
    let gz = d_dirs[r * 3 + 2];
    let dx = dirs[r * 3];
    let dy = dirs[r * 3 + 1];
    let dz = dirs[r * 3 + 2];
    #[unroll]
    for k in 0..3usize {
        A::add(&out[to + k], d_origins[r * 3 + k]);
    }
    A::add(&out[to + 3], dy * gz - dz * gy);
    A::add(&out[to + 4], dz * gx - dx * gz);
    A::add(&out[to + 5], dx * gy - dy * gx);
    let h = 4e-3f32;
    let wide = direction(c, camera, pixels[r * 2], pixels[r * 2 + 1], 1.0 + h);
    let narrow = direction(c, camera, pixels[r * 2], pixels[r * 2 + 1], 1.0 - h);
    let slope = Direction { x: (wide.x - narrow.x) / (2.0 * h), y: (wide.y - narrow.y) / (2.0 * h), z: (wide.z - narrow.z) / (2.0 * h) };
    let d = rotate_to_world(c, camera, &slope);
    A::add(&out[to + 6], d.x * gx + d.y * gy + d.z * gz);
}
