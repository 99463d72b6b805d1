//! Contact sheet of a data set: thumbnails of the photographs, and plots of the camera frusta and the points from above and from the side.

use crate::error::Result;
use diorama_data::photo;
use diorama_geom::capture::Split;
use diorama_geom::glam::{DVec2, DVec3};
use diorama_geom::{Capture, ImageU8, SparsePoint};
use rayon::prelude::*;
use std::path::Path;

/// Longest side of a thumbnail in pixels, thumbnails per row, and edge of the plots in pixels.
const THUMB: usize = 128;
const COLUMNS: usize = 10;
const PLAN: usize = COLUMNS * THUMB / 2;
/// Most thumbnails.
const SHOWN: usize = 200;
const TRAIN: [u8; 3] = [40, 90, 200];
const HELD_OUT: [u8; 3] = [220, 60, 40];

/// Draws the contact sheet and saves it as PNG.
///
/// # Errors
/// When a photograph cannot be read or the sheet cannot be written.
pub fn draw(path: &Path, capture: &Capture, points: &[SparsePoint]) -> Result<()> {
    let n = capture.frames.len();
    let shown: Vec<usize> = (0..n.min(SHOWN)).map(|i| i * n / n.min(SHOWN)).collect();
    let thumbs: Vec<ImageU8> = shown.par_iter().map(|i| Ok(photo::load_small(&capture.frames[*i].image, THUMB)?)).collect::<Result<_>>()?;
    let rows = thumbs.len().div_ceil(COLUMNS);
    let (width, height) = (COLUMNS * THUMB, PLAN + rows * THUMB);
    let mut sheet = ImageU8 { width, height, channels: 3, data: vec![255; width * height * 3] };
    plan(&mut sheet, 0, capture, points, |p| DVec2::new(p.x, -p.y));
    plan(&mut sheet, PLAN, capture, points, |p| DVec2::new(p.x, -p.z));
    for (k, (thumb, i)) in thumbs.iter().zip(&shown).enumerate() {
        let (x0, y0) = (k % COLUMNS * THUMB + (THUMB - thumb.width) / 2, PLAN + k / COLUMNS * THUMB + (THUMB - thumb.height) / 2);
        for y in 0..thumb.height {
            for x in 0..thumb.width {
                let p = thumb.pixel(x, y);
                dot(&mut sheet, (x0 + x) as f64, (y0 + y) as f64, [p[0], p[1], p[2]]);
            }
        }
        let held = capture.frames[*i].split != Split::Train;
        (0..thumb.width)
            .for_each(|x| (0..3).for_each(|y| dot(&mut sheet, (x0 + x) as f64, (y0 + y) as f64, if held { HELD_OUT } else { TRAIN })));
    }
    Ok(photo::save_png(path, &sheet)?)
}

/// Plots points and frusta, projected by `flat`, into the square with left edge `x0`.
fn plan(sheet: &mut ImageU8, x0: usize, capture: &Capture, points: &[SparsePoint], flat: impl Fn(DVec3) -> DVec2) {
    let reach = capture.frames.iter().map(|f| flat(f.world_from_camera.translation).abs().max_element()).fold(1e-6, f64::max) * 1.25;
    let place = |p: DVec3| (flat(p) / reach + 1.0) * 0.5 * (PLAN - 1) as f64;
    let inside = |q: DVec2| q.min_element() >= 0.0 && q.max_element() < PLAN as f64;
    for p in points {
        let q = place(p.position);
        if inside(q) {
            dot(sheet, x0 as f64 + q.x, q.y, p.color);
        }
    }
    for f in &capture.frames {
        let color = if f.split == Split::Train { TRAIN } else { HELD_OUT };
        let (c, eye) = (&f.camera, f.world_from_camera.translation);
        let corner = |x: f64, y: f64| f.world_from_camera.point(c.direction(x * c.width as f64, y * c.height as f64) * 0.09 * reach);
        let corners = [corner(0.0, 0.0), corner(1.0, 0.0), corner(1.0, 1.0), corner(0.0, 1.0)];
        for k in 0..4 {
            for (a, b) in [(eye, corners[k]), (corners[k], corners[(k + 1) % 4])] {
                let (a, b) = (place(a), place(b));
                let steps = (b - a).abs().max_element().ceil().max(1.0);
                for t in 0..=steps as usize {
                    let q = a.lerp(b, t as f64 / steps);
                    if inside(q) {
                        dot(sheet, x0 as f64 + q.x, q.y, color);
                    }
                }
            }
        }
    }
}

fn dot(sheet: &mut ImageU8, x: f64, y: f64, color: [u8; 3]) {
    let (x, y) = (x as usize, y as usize);
    if x < sheet.width && y < sheet.height {
        let i = (y * sheet.width + x) * 3;
        sheet.data[i..i + 3].copy_from_slice(&color);
    }
}
