//! Clouds of points: thinned, without outliers, and with neighbors at hand.

use diorama_geom::glam::DVec3;
use rayon::prelude::*;
use std::collections::HashMap;

/// Most points that are kept.
const MOST: usize = 20_000;
/// Neighbors whose mean distance tells outliers, and standard deviations beyond the mean at which they begin.
const NEIGHBORS: usize = 16;
const OUTLYING: f64 = 2.0;
/// How much coarser each attempt to thin is.
const COARSER: f64 = 1.1;
/// Share of the points on either side of an axis that extents leave out.
const OUTERMOST: f64 = 0.05;

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

    /// Points within a distance.
    pub fn within(&self, p: DVec3, radius: f64) -> Vec<DVec3> {
        let (low, high) = (cell(p - radius, self.edge), cell(p + radius, self.edge));
        let is_near = |q: &DVec3| q.distance_squared(p) <= radius * radius;
        let count = (0..3).map(|k| (high[k] - low[k] + 1) as f64).product::<f64>();
        // Where there are fewer points than cells, as around a point far from all.
        if count > self.points.len() as f64 {
            return self.points.iter().copied().filter(is_near).collect();
        }
        let mut out = Vec::new();
        for x in low[0]..=high[0] {
            for y in low[1]..=high[1] {
                for z in low[2]..=high[2] {
                    let near = self.cells.get(&[x, y, z]).into_iter().flatten().map(|i| self.points[*i as usize]);
                    out.extend(near.filter(is_near));
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

/// Largest extent along an axis of all but the outermost twentieth on either side.
fn extent(points: &[DVec3]) -> f64 {
    let along = |axis: usize| {
        let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share) as usize];
        if values.is_empty() { 0.0 } else { at(1.0 - OUTERMOST) - at(OUTERMOST) }
    };
    (0..3).map(along).fold(1e-12, f64::max)
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
        size *= COARSER;
    }
}

/// The finite points, thinned to at most 20,000 and without those whose sixteen nearest neighbors are farther away than the mean by two standard
/// deviations, and the median distance to the nearest neighbor.
pub fn cleaned(points: &[DVec3]) -> (Vec<DVec3>, f64) {
    let finite: Vec<DVec3> = points.iter().copied().filter(|p| p.is_finite()).collect();
    let points = thinned(&finite);
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
