//! Foreground masks of photographs: GrabCut seeded with the points of structure from motion, or a segmentation network that the user gives.

use super::grab_cut::{Seed, grab_cut};
use diorama_data::colmap::Observed;
use diorama_geom::ImageU8;
use diorama_geom::capture::Frame;
use diorama_geom::glam::{DVec2, DVec3};
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::PathBuf;

/// Method that separates foreground and background.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub enum Background {
    #[default]
    Keep,
    /// GrabCut, seeded with the points of structure from motion.
    Auto,
    /// An ONNX network from an image `[1, 3, S, S]` to a mask.
    Network(PathBuf),
}

impl std::str::FromStr for Background {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "off" => Ok(Background::Keep),
            "auto" => Ok(Background::Auto),
            file if file.ends_with(".onnx") => Ok(Background::Network(file.into())),
            _ => Err(format!("remove-background {s:?}: expected auto, off or a file NETWORK.onnx")),
        }
    }
}

/// Longest side in pixels of the image that GrabCut runs on.
const CUT_PX: usize = 360;
/// Least number of cameras that have an object point in view, as a share of the most that have any point in view.
const SEEN: f64 = 0.6;
/// Greatest distance of an object point from the median center, in median distances.
const REACH: f64 = 2.5;
/// A supporting plane (table, floor or wall): its thickness as a share of the cameras' distance, the least share of the points on it, and
/// the largest share behind it.
const LAYER: f64 = 0.012;
const ON_SUPPORT: f64 = 0.1;
const BEHIND: f64 = 0.06;
/// Supporting planes that are removed, and planes that RANSAC tries for each.
const SUPPORTS: usize = 3;
const TRIALS: u64 = 600;
/// Width of the undecided zone around the object's outline, as a share of the outline's extent in the image.
const ZONE: f64 = 0.2;

/// Points by number, with their positions and whether they belong to the object.
pub struct Subject {
    points: HashMap<u64, (DVec3, bool)>,
}

impl Subject {
    /// Separates the object from its surroundings: the object is what most cameras have in view, in front of the planes that support it.
    /// `points` are (number, position, images) in the world of `frames`.
    pub fn find(frames: &[Frame], points: &[(u64, DVec3, usize)]) -> Subject {
        let views: Vec<_> = frames.iter().map(|f| (f.world_from_camera.inverse(), &f.camera)).collect();
        let firm: Vec<&(u64, DVec3, usize)> = points.iter().filter(|p| p.2 >= 3).collect();
        let in_view = |p: DVec3| {
            let seen = |(camera_from_world, c): &&(diorama_geom::Pose, &diorama_geom::Camera)| {
                let q = camera_from_world.point(p);
                let inside = |px: DVec2| (0.0..c.width as f64).contains(&px.x) && (0.0..c.height as f64).contains(&px.y);
                q.z > 0.0 && c.project(q).is_some_and(inside)
            };
            views.iter().filter(seen).count()
        };
        let counts: Vec<usize> = firm.par_iter().map(|p| in_view(p.1)).collect();
        let most = counts.iter().max().copied().unwrap_or(0) as f64;
        let distance = super::super::world::DISTANCE;
        let mut near: Vec<&(u64, DVec3, usize)> = firm
            .into_iter()
            .zip(&counts)
            .filter(|(p, n)| **n as f64 >= SEEN * most && p.1.length() < 0.6 * distance)
            .map(|p| p.0)
            .collect();
        let eyes: Vec<DVec3> = frames.iter().map(|f| f.world_from_camera.translation).collect();
        for round in 0..SUPPORTS {
            let Some((n, d)) = support(&near, &eyes, LAYER * distance, round as u64) else { break };
            near.retain(|p| p.1.dot(n) - d > LAYER * distance);
        }
        let middle_of = |v: &mut Vec<f64>| {
            v.sort_by(f64::total_cmp);
            v.get(v.len() / 2).copied().unwrap_or(0.0)
        };
        let middle = DVec3::from([0, 1, 2].map(|k| middle_of(&mut near.iter().map(|p| p.1[k]).collect())));
        let radius = middle_of(&mut near.iter().map(|p| (p.1 - middle).length()).collect());
        let own: std::collections::HashSet<u64> = near.iter().filter(|p| (p.1 - middle).length() <= REACH * radius).map(|p| p.0).collect();
        Subject { points: points.iter().filter(|p| p.2 >= 3).map(|p| (p.0, (p.1, own.contains(&p.0)))).collect() }
    }

    /// Whether a point belongs to the object.
    pub fn is_own(&self, id: u64) -> bool {
        self.points.get(&id).is_some_and(|p| p.1)
    }

    /// Number of the object's points.
    pub fn size(&self) -> usize {
        self.points.values().filter(|p| p.1).count()
    }

    /// Opacity of each pixel of a photograph, `[height, width]`; 0 is background.
    pub fn alpha(&self, image: &ImageU8, frame: &Frame, observed: Option<&Observed>) -> Vec<u8> {
        let by = (CUT_PX as f64 / image.width.max(image.height) as f64).min(1.0);
        let (w, h) = (((image.width as f64 * by) as usize).max(1), ((image.height as f64 * by) as usize).max(1));
        let small = image.downsampled(w, h);
        let inside = grab_cut(&small, &self.seeds(frame, observed, w, h));
        let mask: Vec<f32> = keep_large(&inside, w, h).into_iter().map(|v| v as u8 as f32).collect();
        enlarge(&mask, &small, image)
    }

    /// GrabCut seeds at `w × h`: inside the convex hull of the object's points, probably foreground; in a zone around it, probably background;
    /// outside, background. Pixels of observed points are foreground for the object's, background for others.
    fn seeds(&self, frame: &Frame, observed: Option<&Observed>, w: usize, h: usize) -> Vec<Seed> {
        let camera_from_world = frame.world_from_camera.inverse();
        let (sx, sy) = (w as f64 / frame.camera.width as f64, h as f64 / frame.camera.height as f64);
        let project = |p: DVec3| {
            let q = camera_from_world.point(p);
            frame.camera.project(q).filter(|_| q.z > 0.0).map(|px| DVec2::new(px.x * sx, px.y * sy))
        };
        let outline = hull(self.points.values().filter(|p| p.1).filter_map(|p| project(p.0)).collect());
        let extent = |k: usize| {
            let (lo, hi) = outline.iter().fold((f64::MAX, f64::MIN), |(lo, hi), p| (lo.min(p[k]), hi.max(p[k])));
            (hi - lo).max(0.0)
        };
        let zone = if outline.len() < 3 { 0.0 } else { ZONE * extent(0).max(extent(1)) };
        let mut seeds: Vec<Seed> = (0..w * h)
            .map(|i| match outside(&outline, DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)) {
                d if d <= 0.0 => Seed::MaybeForeground,
                d if d <= zone => Seed::MaybeBackground,
                _ => Seed::Background,
            })
            .collect();
        for (px, id) in observed.iter().flat_map(|o| &o.points) {
            let Some((_, own)) = self.points.get(id) else { continue };
            let (x, y) = ((px[0] * sx) as i64, (px[1] * sy) as i64);
            if x < 0 || y < 0 || x >= w as i64 || y >= h as i64 {
                continue;
            }
            // `keep_large` fills the one-pixel hole that a wrong point leaves.
            seeds[y as usize * w + x as usize] = if *own { Seed::Foreground } else { Seed::Background };
        }
        seeds
    }
}

/// The plane (normal, offset) with the most points on it that has all cameras in front and almost no points behind (RANSAC).
fn support(points: &[&(u64, DVec3, usize)], eyes: &[DVec3], layer: f64, round: u64) -> Option<(DVec3, f64)> {
    let total = points.len() as f64;
    let rng = diorama_geom::rng::Rng::new(round, 41);
    let of = |trial: u64| {
        let pick = |k: u64| points[rng.below(trial * 3 + k, points.len().max(1) as u64) as usize].1;
        let (a, b, c) = (pick(0), pick(1), pick(2));
        let n = (b - a).cross(c - a).try_normalize()?;
        let n = if (eyes[0] - a).dot(n) < 0.0 { -n } else { n };
        let d = a.dot(n);
        if eyes.iter().any(|e| e.dot(n) - d < 3.0 * layer) {
            return None;
        }
        let on = points.iter().filter(|p| (p.1.dot(n) - d).abs() < layer).count();
        let behind = points.iter().filter(|p| p.1.dot(n) - d < -2.0 * layer).count();
        (on as f64 > ON_SUPPORT * total && (behind as f64) < BEHIND * total).then_some((on, n, d))
    };
    if points.len() < 3 {
        return None;
    }
    let found: Vec<Option<(usize, DVec3, f64)>> = (0..TRIALS).into_par_iter().map(of).collect();
    found.into_iter().flatten().max_by_key(|f| f.0).map(|f| (f.1, f.2))
}

/// Convex hull, counter-clockwise (Andrew's monotone chain).
fn hull(mut p: Vec<DVec2>) -> Vec<DVec2> {
    p.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let chain = |points: &mut dyn Iterator<Item = &DVec2>| {
        let mut out: Vec<DVec2> = Vec::new();
        for q in points {
            while out.len() > 1 && (out[out.len() - 1] - out[out.len() - 2]).perp_dot(*q - out[out.len() - 1]) <= 0.0 {
                out.pop();
            }
            out.push(*q);
        }
        out.pop();
        out
    };
    let mut out = chain(&mut p.iter());
    out.extend(chain(&mut p.iter().rev()));
    out
}

/// Distance from a point to a convex hull: 0 inside, infinite for a hull of fewer than three points.
fn outside(hull: &[DVec2], p: DVec2) -> f64 {
    let n = hull.len();
    if n < 3 {
        return f64::INFINITY;
    }
    let side = |i: usize| {
        let (a, b) = (hull[i], hull[(i + 1) % n]);
        -(b - a).perp_dot(p - a) / (b - a).length().max(1e-12)
    };
    if (0..n).all(|i| side(i) <= 0.0) {
        return 0.0;
    }
    let to_edge = |i: usize| {
        let (a, b) = (hull[i], hull[(i + 1) % n]);
        let t = ((p - a).dot(b - a) / (b - a).length_squared().max(1e-12)).clamp(0.0, 1.0);
        (a + (b - a) * t).distance(p)
    };
    (0..n).map(to_edge).fold(f64::INFINITY, f64::min)
}

/// Removes foreground components smaller than a tenth of the largest one, then fills holes smaller than 1/500 of the image.
fn keep_large(mask: &[bool], w: usize, h: usize) -> Vec<bool> {
    let drop_small = |mask: &[bool], value: bool, smallest: &dyn Fn(usize) -> usize| {
        let mut part = vec![usize::MAX; w * h];
        let mut sizes = Vec::new();
        for first in 0..w * h {
            if mask[first] != value || part[first] != usize::MAX {
                continue;
            }
            let id = sizes.len();
            let mut size = 0;
            part[first] = id;
            let mut stack = vec![first];
            while let Some(i) = stack.pop() {
                size += 1;
                let (x, y) = (i % w, i / w);
                let around = [(x > 0).then(|| i - 1), (x + 1 < w).then(|| i + 1), (y > 0).then(|| i - w), (y + 1 < h).then(|| i + w)];
                for j in around.into_iter().flatten() {
                    if mask[j] == value && part[j] == usize::MAX {
                        part[j] = id;
                        stack.push(j);
                    }
                }
            }
            sizes.push(size);
        }
        let least = smallest(sizes.iter().max().copied().unwrap_or(0));
        (0..w * h).map(|i| if mask[i] == value && sizes[part[i]] < least { !value } else { mask[i] }).collect::<Vec<bool>>()
    };
    let without_specks = drop_small(mask, true, &|largest| largest / 10);
    drop_small(&without_specks, false, &|_| w * h / 500)
}

/// Upsamples a mask along image edges with a guided filter, whose linear coefficients are computed at low resolution and applied at full
/// resolution (He and Sun, "Fast guided filter", 2015).
fn enlarge(mask: &[f32], small: &ImageU8, full: &ImageU8) -> Vec<u8> {
    /// Window radius in pixels, and the regularizer ε: the brightness variance of flat regions.
    const RADIUS: usize = 3;
    const FLAT: f32 = 1e-3;
    let (w, h) = (small.width, small.height);
    let gray = |p: &[u8]| (p[0] as f32 + p[1] as f32 + p[2] as f32) / 765.0;
    let guide: Vec<f32> = small.data.chunks_exact(small.channels).map(gray).collect();
    let mean = |v: &dyn Fn(usize) -> f32| -> Vec<f32> {
        let around = |i: usize, n: usize| i.saturating_sub(RADIUS)..(i + RADIUS + 1).min(n);
        let rows: Vec<f32> = (0..w * h)
            .map(|i| {
                let r = around(i % w, w);
                r.clone().map(|x| v(i / w * w + x)).sum::<f32>() / r.len() as f32
            })
            .collect();
        (0..w * h)
            .map(|i| {
                let r = around(i / w, h);
                r.clone().map(|y| rows[y * w + i % w]).sum::<f32>() / r.len() as f32
            })
            .collect()
    };
    let (mg, mm) = (mean(&|i| guide[i]), mean(&|i| mask[i]));
    let (mgg, mgm) = (mean(&|i| guide[i] * guide[i]), mean(&|i| guide[i] * mask[i]));
    let slope: Vec<f32> = (0..w * h).map(|i| (mgm[i] - mg[i] * mm[i]) / (mgg[i] - mg[i] * mg[i] + FLAT)).collect();
    let offset: Vec<f32> = (0..w * h).map(|i| mm[i] - slope[i] * mg[i]).collect();
    let (slope, offset) = (mean(&|i| slope[i]), mean(&|i| offset[i]));
    let at = |v: &[f32], x: f32, y: f32| {
        let (x, y) = (x.clamp(0.0, (w - 1) as f32), y.clamp(0.0, (h - 1) as f32));
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let row = |y: usize| v[y * w + x0] * (1.0 - fx) + v[y * w + x1] * fx;
        row(y0) * (1.0 - fy) + row(y1) * fy
    };
    let (sx, sy) = (w as f32 / full.width as f32, h as f32 / full.height as f32);
    let pixel = |(i, p): (usize, &[u8])| {
        let (x, y) = (((i % full.width) as f32 + 0.5) * sx - 0.5, ((i / full.width) as f32 + 0.5) * sy - 0.5);
        let a = at(&slope, x, y) * gray(p) + at(&offset, x, y);
        // Steepen the border to suppress the filter's halos.
        (((a - 0.5) * 3.0 + 0.5).clamp(0.0, 1.0) * 255.0 + 0.5) as u8
    };
    full.data.par_chunks_exact(full.channels).enumerate().map(pixel).collect()
}

/// The photograph with an alpha channel.
pub fn with_alpha(image: &ImageU8, alpha: &[u8]) -> ImageU8 {
    let rgba = image.data.chunks_exact(image.channels).zip(alpha).flat_map(|(p, a)| [p[0], p[1], p[2], *a]).collect();
    ImageU8 { channels: 4, data: rgba, ..*image }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;
    use diorama_geom::{Camera, Pose, Ray};
    use diorama_scenes::ray_caster::{Object, Scene, Shape, Texture};

    /// A dotted box and ball on a dotted floor; also returns how many of the first objects belong to the subject.
    fn scene() -> (Scene, usize) {
        let object = |shape, a: [f64; 3], b: [f64; 3], size| Object {
            shape,
            texture: Texture::Dots { a: DVec3::from(a), b: DVec3::from(b), size },
            gloss: 0.0,
        };
        let floor = Shape::Box { center: DVec3::new(0.0, 0.0, -1.55), half: DVec3::new(8.0, 8.0, 1.0), angle: 0.0 };
        let body = Shape::Box { center: DVec3::new(0.0, 0.0, -0.15), half: DVec3::new(0.5, 0.35, 0.4), angle: 0.4 };
        let ball = Shape::Sphere { center: DVec3::new(0.0, 0.0, 0.55), radius: 0.35 };
        let objects = vec![
            object(body, [0.8, 0.1, 0.05], [0.85, 0.6, 0.1], 0.12),
            object(ball, [0.7, 0.05, 0.3], [0.9, 0.7, 0.2], 0.1),
            object(floor, [0.25, 0.3, 0.3], [0.1, 0.2, 0.35], 0.3),
        ];
        (Scene { objects, sun: DVec3::new(0.4, -0.5, 0.77).normalize(), ambient: 0.6 }, 2)
    }

    #[test]
    fn the_thing_is_cut_from_the_room() {
        let (scene, things) = scene();
        let camera = Camera::pinhole(240, 180, 0.9);
        let frames: Vec<Frame> = (0..16)
            .map(|i| {
                let a = i as f64 * 0.4;
                let eye = DVec3::new(3.7 * a.cos(), 3.7 * a.sin(), 1.5);
                Frame::new(format!("{i}"), "", camera, Pose::look_at(eye, DVec3::ZERO, DVec3::Z))
            })
            .collect();
        let alone = Scene { objects: scene.objects[..things].to_vec(), ..scene.clone() };
        // Points like those of structure from motion: hits of random rays from random views.
        let rng = Rng::new(4, 0);
        let mut points = Vec::new();
        let mut observed: Vec<Observed> = frames.iter().map(|f| Observed { image: f.name.clone(), points: Vec::new() }).collect();
        for n in 0..1500u64 {
            let f = &frames[rng.below(3 * n, 16) as usize];
            let px = DVec2::new(rng.uniform(3 * n + 1) as f64 * 240.0, rng.uniform(3 * n + 2) as f64 * 180.0);
            let ray =
                Ray { origin: f.world_from_camera.translation, direction: f.world_from_camera.rotation * camera.direction(px.x, px.y) };
            let Some((_, t)) = scene.trace(&ray) else { continue };
            let p = ray.origin + ray.direction * t;
            for (o, f) in observed.iter_mut().zip(&frames) {
                let to = p - f.world_from_camera.translation;
                let ray = Ray { origin: f.world_from_camera.translation, direction: to.normalize() };
                let visible = scene.trace(&ray).is_some_and(|(_, t)| (t - to.length()).abs() < 1e-3);
                let q = f.world_from_camera.inverse().point(p);
                if let Some(px) =
                    camera.project(q).filter(|px| visible && q.z > 0.0 && px.x >= 0.0 && px.y >= 0.0 && px.x < 240.0 && px.y < 180.0)
                {
                    o.points.push((px.to_array(), n));
                }
            }
            points.push((n, p, 5));
        }
        let subject = Subject::find(&frames, &points);
        assert!(subject.size() > 50, "{}", subject.size());
        for i in [0, 5, 11] {
            let f = &frames[i];
            let photo = scene.render(&camera, &f.world_from_camera, 2);
            let photo = ImageU8 { channels: 3, data: photo.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect(), ..photo };
            let truth = alone.render(&camera, &f.world_from_camera, 2);
            let alpha = subject.alpha(&photo, f, Some(&observed[i]));
            let (mut both, mut either) = (0, 0);
            for (a, t) in alpha.iter().zip(truth.data.chunks_exact(4)) {
                both += (*a > 127 && t[3] > 127) as usize;
                either += (*a > 127 || t[3] > 127) as usize;
            }
            assert!(both as f64 > 0.9 * either as f64, "view {i}: intersection over union {}", both as f64 / either as f64);
        }
    }

    #[test]
    fn hulls_know_their_inside() {
        let square = hull([(0.0, 0.0), (2.0, 0.0), (1.0, 1.0), (2.0, 2.0), (0.0, 2.0)].map(|(x, y)| DVec2::new(x, y)).to_vec());
        assert_eq!(square.len(), 4);
        assert!(outside(&square, DVec2::ONE) <= 0.0);
        assert!((outside(&square, DVec2::new(3.0, 1.0)) - 1.0).abs() < 1e-9);
        assert!((outside(&square, DVec2::new(5.0, 6.0)) - 5.0).abs() < 1e-9);
    }
}
