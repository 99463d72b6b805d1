//! Visual hull (Laurentini 1994): the points of space that all masks allow, as a signed distance.

use super::placement::Placement;
use diorama_geom::capture::focus_point;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Image, Pose};
use rayon::prelude::*;

/// Cells along an axis when the object is searched.
const CELLS: usize = 48;
/// Width over which a found box is widened, in cells.
const WIDEN: f64 = 0.75;

/// A mask as a signed distance in pixels, inside positive.
pub struct Silhouette {
    camera: Camera,
    pose: Pose,
    camera_from_world: Pose,
    distance: Image,
    /// Largest distance of a ray through the mask from a point; see [`Silhouette::reach`].
    inside: Vec<(f64, f64)>,
}

impl Silhouette {
    /// Of a photograph with opacity in its fourth channel.
    pub fn new(rgba: &Image, camera: Camera, pose: Pose) -> Silhouette {
        let (w, h) = (rgba.width, rgba.height);
        let is_inside: Vec<bool> = rgba.data.as_chunks::<4>().0.iter().map(|p| p[3] > 0.5).collect();
        // Distances of centers; the border lies half a pixel before the nearest center of the other kind.
        let (to_outside, to_inside) = (squared_distances(&is_inside, false, w, h), squared_distances(&is_inside, true, w, h));
        let signed = |i: usize| if is_inside[i] { to_outside[i].sqrt() - 0.5 } else { 0.5 - to_inside[i].sqrt() };
        let data = (0..w * h).map(signed).collect();
        // Pixels of the border are enough for the mask's extent.
        let border = (0..w * h).filter(|i| is_inside[*i] && to_outside[*i] <= 1.0);
        let inside = border.map(|i| ((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)).collect();
        Silhouette { camera, pose, camera_from_world: pose.inverse(), distance: Image { width: w, height: h, channels: 1, data }, inside }
    }

    /// Signed distance in units of the world at the depth of a point; none where the photograph does not show it.
    fn at(&self, p: DVec3) -> Option<f64> {
        let q = self.camera_from_world.point(p);
        let px = self.camera.project(q).filter(|_| q.z > 0.0)?;
        let (x, y) = (px.x - 0.5, px.y - 0.5);
        let (w, h) = (self.distance.width, self.distance.height);
        if !(0.0..(w - 1) as f64).contains(&x) || !(0.0..(h - 1) as f64).contains(&y) {
            return None;
        }
        let (left, top) = (x as usize, y as usize);
        let (fx, fy) = (x - left as f64, y - top as f64);
        let d = |dx: usize, dy: usize| self.distance.data[(top + dy) * w + left + dx] as f64;
        let across = |dy: usize| d(0, dy) * (1.0 - fx) + d(1, dy) * fx;
        Some((across(0) * (1.0 - fy) + across(1) * fy) * q.z / self.camera.fx.min(self.camera.fy))
    }

    /// Whether the photograph shows a point within so far of its mask's border, in units of the world.
    pub fn has_border(&self, p: DVec3, width: f64) -> bool {
        self.at(p).is_some_and(|d| d.abs() < width)
    }

    /// Largest distance of a ray through the mask from a point.
    fn reach(&self, p: DVec3) -> f64 {
        let away = |(x, y): &(f64, f64)| (p - self.pose.translation).cross(self.pose.rotation * self.camera.direction(*x, *y)).length();
        self.inside.iter().map(away).fold(0.0, f64::max)
    }
}

/// Signed distance to the hull, inside positive, exact outside of edges only; points that no photograph shows are outside.
pub fn distance(silhouettes: &[Silhouette], p: DVec3) -> f64 {
    let mut least = f64::INFINITY;
    for s in silhouettes {
        if let Some(d) = s.at(p) {
            least = least.min(d);
        }
    }
    if least.is_finite() { least } else { -f64::MAX }
}

/// Whether a point lies in the hull.
pub fn contains(silhouettes: &[Silhouette], p: DVec3) -> bool {
    let mut is_shown = false;
    for s in silhouettes {
        match s.at(p) {
            Some(d) if d <= 0.0 => return false,
            Some(_) => is_shown = true,
            None => {}
        }
    }
    is_shown
}

/// Center and half size of the hull; none where it is empty.
pub fn locate(silhouettes: &[Silhouette]) -> Option<Placement> {
    let poses: Vec<Pose> = silhouettes.iter().map(|s| s.pose).collect();
    let (focus, _) = focus_point(&poses);
    let half = silhouettes.iter().map(|s| s.reach(focus)).fold(0.0, f64::max);
    let mut placement = Placement { center: focus, scale: 1.02 * half };
    for _ in 0..2 {
        placement = bounds(silhouettes, &placement)?;
    }
    Some(placement)
}

/// The bounds of the hull within a cube.
fn bounds(silhouettes: &[Silhouette], of: &Placement) -> Option<Placement> {
    let cell = 2.0 * of.scale / CELLS as f64;
    let inside = |i: usize| {
        let place = [i % CELLS, i / CELLS % CELLS, i / CELLS / CELLS].map(|v| (v as f64 + 0.5) * cell - of.scale);
        let p = of.center + DVec3::from(place);
        // A cell counts if the hull may touch it.
        (distance(silhouettes, p) > -0.5 * cell).then_some((p, p))
    };
    let joined = |a: Option<(DVec3, DVec3)>, b: Option<(DVec3, DVec3)>| match (a, b) {
        (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
        (a, b) => a.or(b),
    };
    let (low, high) = (0..CELLS.pow(3)).into_par_iter().map(inside).reduce(|| None, joined)?;
    Some(Placement { center: 0.5 * (low + high), scale: 0.5 * (high - low).max_element() + WIDEN * cell })
}

/// Squared distance from each pixel's center to the nearest center of the kind `of` (Felzenszwalb and Huttenlocher 2012); large where there
/// is none.
fn squared_distances(is_inside: &[bool], of: bool, w: usize, h: usize) -> Vec<f32> {
    const FAR: f32 = 1e12;
    let mut d: Vec<f32> = is_inside.iter().map(|v| if *v == of { 0.0 } else { FAR }).collect();
    let mut column = vec![0.0; h];
    for x in 0..w {
        (0..h).for_each(|y| column[y] = d[y * w + x]);
        for (y, v) in parabolas(&column).into_iter().enumerate() {
            d[y * w + x] = v;
        }
    }
    for row in d.chunks_exact_mut(w) {
        let out = parabolas(row);
        row.copy_from_slice(&out);
    }
    d
}

/// `min_j (i − j)² + f(j)` for each `i`: the lower envelope of parabolas.
fn parabolas(f: &[f32]) -> Vec<f32> {
    let n = f.len();
    let (mut at, mut from) = (vec![0usize; n], vec![0.0f64; n + 1]);
    let mut k = 0;
    (from[0], from[1]) = (f64::NEG_INFINITY, f64::INFINITY);
    let value = |j: usize| f[j] as f64 + (j * j) as f64;
    for j in 1..n {
        let mut s;
        loop {
            s = (value(j) - value(at[k])) / (2 * j - 2 * at[k]) as f64;
            if s > from[k] || k == 0 {
                break;
            }
            k -= 1;
        }
        if s > from[k] {
            k += 1;
        }
        (at[k], from[k], from[k + 1]) = (j, s, f64::INFINITY);
    }
    let mut k = 0;
    (0..n)
        .map(|i| {
            while from[k + 1] < i as f64 {
                k += 1;
            }
            let away = i as f64 - at[k] as f64;
            (away * away + f[at[k]] as f64) as f32
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_of_all_pairs() {
        let (w, h) = (13, 9);
        let inside: Vec<bool> = (0..w * h).map(|i| (i * 7919) % 11 < 3).collect();
        let got = squared_distances(&inside, true, w, h);
        for i in 0..w * h {
            let away = |j: usize| ((i % w) as f32 - (j % w) as f32).powi(2) + ((i / w) as f32 - (j / w) as f32).powi(2);
            let want = (0..w * h).filter(|j| inside[*j]).map(away).fold(f32::MAX, f32::min);
            assert_eq!(got[i], want, "{i}");
        }
    }

    #[test]
    fn a_ball_is_found_where_it_is() {
        let (center, radius) = (DVec3::new(0.4, -0.2, 0.7), 0.3);
        let camera = Camera::pinhole(64, 64, 0.7);
        let silhouettes: Vec<Silhouette> = (0..12)
            .map(|i| {
                let (angle, z) = (i as f64 * 2.4, -0.8 + 1.6 * (i as f64 + 0.5) / 12.0);
                let r = (1.0 - z * z).sqrt();
                let eye = center + 2.0 * DVec3::new(r * angle.cos(), r * angle.sin(), z);
                let pose = Pose::look_at(eye, center + DVec3::splat(0.05), DVec3::Z);
                let mut image = Image::zeros(64, 64, 4);
                for p in 0..64 * 64 {
                    let d = pose.rotation * camera.direction((p % 64) as f64 + 0.5, (p / 64) as f64 + 0.5);
                    image.data[4 * p + 3] = ((center - eye).cross(d).length() < radius) as u32 as f32;
                }
                Silhouette::new(&image, camera, pose)
            })
            .collect();
        let found = locate(&silhouettes).unwrap();
        assert!((found.center - center).length() < 0.03 && (0.3..0.36).contains(&found.scale), "{found:?}");
        assert!((distance(&silhouettes, center) - radius).abs() < 0.03);
        assert!(distance(&silhouettes, center + DVec3::X * 0.5) < -0.1);
    }
}
