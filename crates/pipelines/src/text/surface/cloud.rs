//! Clouds of points: thinned, without outliers, and with neighbors at hand.

use diorama_geom::glam::DVec3;
use rayon::prelude::*;
use std::collections::HashMap;

/// Most points that are kept.
const MOST: usize = 20_000;
/// Neighbors whose mean distance tells outliers, and standard deviations beyond the mean at which they begin.
const NEIGHBORS: usize = 16;
const OUTLYING: f64 = 2.0;
/// How much finer each attempt to thin is.
const FINER: f64 = 1.1;

/// Points by the cells of a grid.
pub(super) struct Cells<'a> {
    points: &'a [DVec3],
    edge: f64,
    cells: HashMap<[i64; 3], Vec<u32>>,
}

fn cell(p: DVec3, edge: f64) -> [i64; 3] {
    (p / edge).floor().to_array().map(|v| v as i64)
}

impl<'a> Cells<'a> {
    pub fn new(points: &'a [DVec3], edge: f64) -> Cells<'a> {
        let mut cells: HashMap<[i64; 3], Vec<u32>> = HashMap::new();
        points.iter().enumerate().for_each(|(i, p)| cells.entry(cell(*p, edge)).or_default().push(i as u32));
        Cells { points, edge, cells }
    }

    /// Points within a distance, in the order of the cloud within each cell.
    pub fn within(&self, p: DVec3, radius: f64) -> Vec<DVec3> {
        let (low, high) = (cell(p - radius, self.edge), cell(p + radius, self.edge));
        let mut out = Vec::new();
        for x in low[0]..=high[0] {
            for y in low[1]..=high[1] {
                for z in low[2]..=high[2] {
                    let near = self.cells.get(&[x, y, z]).into_iter().flatten().map(|i| self.points[*i as usize]);
                    out.extend(near.filter(|q| q.distance_squared(p) <= radius * radius));
                }
            }
        }
        out
    }

    /// Distances to the `n` nearest other points, ascending; fewer where there are no more.
    fn nearest(&self, p: DVec3, n: usize) -> Vec<f64> {
        let mut radius = self.edge;
        loop {
            let mut near: Vec<f64> = self.within(p, radius).iter().map(|q| q.distance(p)).collect();
            if near.len() > n || near.len() == self.points.len() {
                near.sort_by(f64::total_cmp);
                // The first is the point itself.
                return near.into_iter().skip(1).take(n).collect();
            }
            radius *= 2.0;
        }
    }
}

fn extent(points: &[DVec3]) -> f64 {
    let low = points.iter().fold(DVec3::INFINITY, |a, p| a.min(*p));
    let high = points.iter().fold(DVec3::NEG_INFINITY, |a, p| a.max(*p));
    (high - low).max_element().max(1e-12)
}

/// Edge of cells that hold about one point of a surface.
fn edge(points: &[DVec3]) -> f64 {
    extent(points) / (points.len() as f64).sqrt().max(1.0)
}

/// One point, the mean, per cell of a grid, so that at most [`MOST`] are left.
fn thinned(points: &[DVec3]) -> Vec<DVec3> {
    if points.len() <= MOST {
        return points.to_vec();
    }
    let mut size = extent(points) / (MOST as f64).sqrt() / 4.0;
    loop {
        let mut cells: HashMap<[i64; 3], (DVec3, f64)> = HashMap::new();
        for p in points {
            let c = cells.entry(cell(*p, size)).or_default();
            *c = (c.0 + *p, c.1 + 1.0);
        }
        if cells.len() <= MOST {
            let mut sorted: Vec<([i64; 3], (DVec3, f64))> = cells.into_iter().collect();
            sorted.sort_by_key(|(at, _)| *at);
            return sorted.into_iter().map(|(_, (sum, n))| sum / n).collect();
        }
        size *= FINER;
    }
}

/// The points thinned to at most 20,000 and without those whose sixteen nearest neighbors are farther away than the mean by two standard
/// deviations, and the median distance to the nearest neighbor.
pub fn cleaned(points: &[DVec3]) -> (Vec<DVec3>, f64) {
    let points = thinned(points);
    let cells = Cells::new(&points, edge(&points));
    let near: Vec<Vec<f64>> = points.par_iter().map(|p| cells.nearest(*p, NEIGHBORS)).collect();
    let means: Vec<f64> = near.iter().map(|d| d.iter().sum::<f64>() / d.len().max(1) as f64).collect();
    let n = means.len().max(1) as f64;
    let mean = means.iter().sum::<f64>() / n;
    let deviation = (means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / n).sqrt();
    let kept = (0..points.len()).filter(|i| means[*i] <= mean + OUTLYING * deviation);
    let mut first: Vec<f64> = near.iter().filter_map(|d| d.first().copied()).collect();
    first.sort_by(f64::total_cmp);
    (kept.map(|i| points[i]).collect(), first.get(first.len() / 2).copied().unwrap_or(0.0))
}
