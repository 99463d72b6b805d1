//! Robust fits: a plane by principal components, a quadric `h(u, v) = a u² + b u v + c v² + d u + e v + f` over it by Gauss and Newton's method on
//! orthogonal distances; both with Tukey's weights.

use super::smoothing::principal;
use super::{LEAST_POINTS, NoSurface, Wanted};
use diorama_geom::glam::{DMat3, DVec2, DVec3, dvec2};
use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

/// Tukey's constant over the median absolute deviation.
const TUKEY: f64 = 4.685 * 1.4826;
const ITERATIONS: usize = 30;
/// Share of the plane's error that a quadric may have, and points that it needs, to be chosen.
const BETTER: f64 = 0.7;
const QUADRIC_POINTS: usize = 200;
/// Height of a quadric over its plane at the points' extent along an axis, over that extent and over its error, below which it is noise of a plane.
const LEAST_BEND: f64 = 0.06;
const LEAST_HEIGHT: f64 = 3.0;
/// Cosine between the normals of least orthogonal and least viewed distances below which the latter holds.
const DIFFERENT: f64 = 0.94;
/// Variance of points across their plane over that along its shorter direction from which on depths' errors are not small.
const THICK: f64 = 0.02;
/// Newton's steps to a foot point.
const FOOT_STEPS: usize = 8;
/// Share of the extent below which an error is none.
const EXACT: f64 = 1e-12;

/// Coefficients of a quadric's height.
const TERMS: usize = 6;

/// Kind of a fitted surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    Plane,
    Quadric,
}

/// A plane or quadric over a plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Surface {
    pub kind: Kind,
    /// u, v and the normal, toward the viewer.
    pub world_from_local: DMat3,
    pub origin: DVec3,
    /// `a` to `f`; zeros of a plane.
    pub height: [f64; TERMS],
    /// Root of the weighted mean of squared orthogonal distances.
    pub rms: f64,
}

fn terms(at: DVec2) -> [f64; TERMS] {
    [at.x * at.x, at.x * at.y, at.y * at.y, at.x, at.y, 1.0]
}

impl Surface {
    /// Height over the plane and its slopes.
    pub fn height_at(&self, at: DVec2) -> (f64, DVec2) {
        let [a, b, c, d, e, _] = self.height;
        let h = terms(at).iter().zip(self.height).map(|(t, c)| t * c).sum();
        (h, dvec2(2.0 * a * at.x + b * at.y + d, b * at.x + 2.0 * c * at.y + e))
    }

    /// The world's point over a point of the plane.
    pub fn point(&self, at: DVec2) -> DVec3 {
        self.origin + self.world_from_local * at.extend(self.height_at(at).0)
    }

    /// Unit normal there, toward the viewer.
    pub fn normal(&self, at: DVec2) -> DVec3 {
        let slope = self.height_at(at).1;
        self.world_from_local * DVec3::new(-slope.x, -slope.y, 1.0).normalize()
    }

    /// The plane's point under the surface's nearest to a point of the world, and the signed distance.
    pub fn nearest(&self, point_in_world: DVec3) -> (DVec2, f64) {
        let x = self.world_from_local.transpose() * (point_in_world - self.origin);
        let mut at = x.truncate();
        let [a, b, c, ..] = self.height;
        for _ in 0..FOOT_STEPS {
            // Zero of the slope of half the squared distance.
            let (h, slope) = self.height_at(at);
            let off = h - x.z;
            let gradient = at - x.truncate() + off * slope;
            let (xx, xy, yy) =
                (1.0 + slope.x * slope.x + 2.0 * a * off, slope.x * slope.y + b * off, 1.0 + slope.y * slope.y + 2.0 * c * off);
            let det = xx * yy - xy * xy;
            if det.abs() < 1e-9 {
                break;
            }
            at -= dvec2(yy * gradient.x - xy * gradient.y, xx * gradient.y - xy * gradient.x) / det;
        }
        let foot = at.extend(self.height_at(at).0);
        (at, (x - foot).length() * (x.z - foot.z).signum())
    }

    /// Whether its bend along an axis is more than noise makes it over the points' extent.
    fn is_bent(&self, points: &[DVec3]) -> bool {
        let axes = [self.world_from_local.x_axis, self.world_from_local.y_axis];
        let extents =
            axes.map(|axis| (points.iter().map(|p| (*p - self.origin).dot(axis).powi(2)).sum::<f64>() / points.len() as f64).sqrt());
        let is_bent = |k: usize| {
            let height = self.height[2 * k].abs() * extents[k].powi(2);
            height > LEAST_BEND * extents[k] && height > LEAST_HEIGHT * self.rms
        };
        is_bent(0) || is_bent(1)
    }

    fn distances(&self, points: &[DVec3]) -> Vec<f64> {
        points.iter().map(|p| self.nearest(*p).1).collect()
    }
}

/// Tukey's weights of distances: `(1 − (d / c)²)²` below `c`, which follows from the median of `|d|`.
fn tukey(distances: &[f64], extent: f64) -> Vec<f64> {
    let mut sizes: Vec<f64> = distances.iter().map(|d| d.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    let c = (TUKEY * sizes[sizes.len() / 2]).max(EXACT * extent);
    distances.iter().map(|d| if d.abs() < c { (1.0 - (d / c).powi(2)).powi(2) } else { 0.0 }).collect()
}

fn rms(distances: &[f64], weights: &[f64]) -> f64 {
    let sum: f64 = distances.iter().zip(weights).map(|(d, w)| w * d * d).sum();
    (sum / weights.iter().sum::<f64>().max(1e-300)).sqrt()
}

/// A surface through points, whose normal looks to where `toward` points.
///
/// # Errors
/// When there are too few points, or they are on one line.
pub fn fit(points: &[DVec3], toward: DVec3, wanted: Wanted) -> Result<Surface, NoSurface> {
    if points.len() < LEAST_POINTS {
        return Err(NoSurface::FewPoints(points.len()));
    }
    let (plane, extent) = plane(points, toward)?;
    if wanted == Wanted::Plane || (wanted == Wanted::Auto && points.len() < QUADRIC_POINTS) {
        return Ok(plane);
    }
    let quadric = quadric(points, plane, extent);
    // Both judged alike: by the distances that each holds for its own.
    let is_better = quadric.rms <= BETTER * plane.rms && plane.rms > EXACT * extent && quadric.is_bent(points);
    Ok(if wanted == Wanted::Quadric || is_better { quadric } else { plane })
}

/// Weights of points by their distances along the viewing direction from a plane, which is fitted to these, first by least absolute deviations;
/// and the plane's normal. Depths err along the view: where they do by more than a region is high, the plane of least orthogonal distances
/// is edge-on.
fn as_viewed(points: &[DVec3], toward: DVec3) -> (Vec<f64>, DVec3) {
    let along = toward.try_normalize().unwrap_or(DVec3::Z);
    let (u, v) = along.any_orthonormal_pair();
    let mean = points.iter().sum::<DVec3>() / points.len() as f64;
    let local: Vec<DVec3> = points.iter().map(|p| DVec3::new((*p - mean).dot(u), (*p - mean).dot(v), (*p - mean).dot(along))).collect();
    let size = local.iter().map(|p| p.truncate().length()).fold(0.0, f64::max).max(1e-300);
    let (mut weights, mut slopes) = (vec![1.0; points.len()], SVector::<f64, 3>::zeros());
    for round in 0..ITERATIONS {
        let (mut a, mut b) = (SMatrix::<f64, 3, 3>::identity() * 1e-9, SVector::<f64, 3>::zeros());
        for (p, w) in local.iter().zip(&weights) {
            let row = SVector::<f64, 3>::new(p.x / size, p.y / size, 1.0);
            a += *w * row * row.transpose();
            b += *w * p.z * row;
        }
        let Some(found) = a.cholesky().map(|f| f.solve(&b)) else { break };
        slopes = found;
        let off: Vec<f64> = local.iter().map(|p| p.z - found[0] * p.x / size - found[1] * p.y / size - found[2]).collect();
        weights = match round < ITERATIONS / 2 {
            true => off.iter().map(|d| 1.0 / d.abs().max(1e-6 * size)).collect(),
            false => tukey(&off, size),
        };
    }
    (weights, (along - u * (slopes[0] / size) - v * (slopes[1] / size)).normalize())
}

/// The plane, and the points' extent along it.
fn plane(points: &[DVec3], toward: DVec3) -> Result<(Surface, f64), NoSurface> {
    let (mut weights, viewed) = as_viewed(points, toward);
    let mut out = None;
    for _ in 0..ITERATIONS {
        let (origin, axes, values) = principal(points, |i| weights[i]);
        let extent = values.z.sqrt();
        if values.y.sqrt() <= 1e-6 * extent {
            return Err(NoSurface::Line);
        }
        let mut normal = axes.x_axis * if axes.x_axis.dot(toward) < 0.0 { -1.0 } else { 1.0 };
        let mut u = axes.z_axis;
        if normal.dot(viewed) < DIFFERENT || values.x > THICK * values.y {
            (normal, u) = (viewed, (u - viewed * u.dot(viewed)).try_normalize().unwrap_or(viewed.any_orthonormal_vector()));
        }
        let mut surface = Surface {
            kind: Kind::Plane,
            world_from_local: DMat3::from_cols(u, normal.cross(u), normal),
            origin,
            height: [0.0; TERMS],
            rms: 0.0,
        };
        let distances = surface.distances(points);
        let next = tukey(&distances, extent);
        surface.rms = rms(&distances, &next);
        let change = next.iter().zip(&weights).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        (weights, out) = (next, Some((surface, extent)));
        if change < 1e-6 {
            break;
        }
    }
    Ok(out.expect("at least one iteration"))
}

/// A quadric over the plane.
fn quadric(points: &[DVec3], plane: Surface, extent: f64) -> Surface {
    let mut surface = Surface { kind: Kind::Quadric, ..plane };
    // All points at first: on a bent surface, most are far from its plane.
    let mut weights = vec![1.0; points.len()];
    for _ in 0..ITERATIONS {
        let (mut a, mut b) = (SMatrix::<f64, TERMS, TERMS>::zeros(), SVector::<f64, TERMS>::zeros());
        for (p, w) in points.iter().zip(&weights) {
            let (at, distance) = surface.nearest(*p);
            let slope = surface.height_at(at).1;
            // The distance falls with the height at the foot point, foreshortened.
            let by_height = 1.0 / (1.0 + slope.length_squared()).sqrt();
            let row = SVector::<f64, TERMS>::from_fn(|i, _| terms(at / extent)[i] * by_height);
            a += *w * row * row.transpose();
            b += *w * distance * row;
        }
        (0..TERMS).for_each(|i| a[(i, i)] += 1e-12 * points.len() as f64);
        let Some(step) = a.cholesky().map(|f| f.solve(&b)) else { break };
        let scale = [2, 2, 2, 1, 1, 0];
        (0..TERMS).for_each(|i| surface.height[i] += step[i] / extent.powi(scale[i]));
        let distances = surface.distances(points);
        weights = tukey(&distances, extent);
        surface.rms = rms(&distances, &weights);
        if step.norm() < 1e-10 * extent {
            break;
        }
    }
    surface
}
