//! The light of surface points by linear least squares, once the direction of its sun is given.

use super::{Fitted, Lit, Place, SUN};
use crate::relight::outdoor::visibility::radiances;
use diorama_geom::glam::Vec3;

/// Unknowns: sun, nine of the sky.
const UNKNOWNS: usize = 10;
/// Pull of the sun toward 0, per point.
const SUN_RIDGE: f64 = 1e-4;
/// Pull of the sky's bands toward those of a sky that is likely, however bright: normals of few directions tell little of them.
const SKY_RIDGE: [f64; 3] = [5e-4, 1e-2, 2.5e-2];
/// Pull of the sky toward 0.
const SKY_LEAST: f64 = 1e-6;
/// Bands of a sky's nine harmonics.
const BAND: [usize; 9] = [0, 1, 1, 1, 2, 2, 2, 2, 2];

/// Least squares for one direction, of which `sunlit` reaches each point.
pub fn solve(points: &[Lit], places: &[Place], sunlit: &[f32], direction: Vec3) -> Fitted {
    let mut sums = [[[0.0f64; UNKNOWNS + 1]; UNKNOWNS]; 3];
    let mut squares = 0.0;
    for ((p, place), sun) in points.iter().zip(places).zip(sunlit) {
        let row: [f64; UNKNOWNS] = std::array::from_fn(|i| if i == 0 { *sun } else { place.sky[i - 1] } as f64);
        for k in 0..3 {
            let weight = p.trust.sqrt() * p.slope[k];
            let (a, y) = ((weight * p.albedo[k]) as f64, (weight * (p.seen[k] - p.albedo[k] * p.sent[k])) as f64);
            for (i, line) in sums[k].iter_mut().enumerate() {
                (i..UNKNOWNS).for_each(|j| line[j] += a * a * row[i] * row[j]);
                line[UNKNOWNS] += a * row[i] * y;
            }
            squares += y * y;
        }
    }
    let n = points.len().max(1) as f64;
    let mut found = Fitted { sun: [0.0; SUN], sky: [0.0; 27], error: squares / (3.0 * n) };
    found.sun[..3].copy_from_slice(&direction.to_array());
    let likely = likely(sunlit.iter().all(|s| *s == 0.0));
    for (k, sums) in sums.iter_mut().enumerate() {
        sums[0][0] += n * SUN_RIDGE;
        (0..9).for_each(|i| (i..9).for_each(|j| sums[1 + i][1 + j] += n * likely[i][j]));
        (0..UNKNOWNS).for_each(|i| (0..i).for_each(|j| sums[i][j] = sums[j][i]));
        // A sun that would take light away is left out.
        let all = without(sums, &[]);
        let x = if all[0] < 0.0 { without(sums, &[0]) } else { all };
        found.sun[3 + k] = x[0] as f32;
        (0..9).for_each(|i| found.sky[3 * i + k] = x[1 + i] as f32);
        // ‖y − Ax‖² = ‖y‖² − 2 xᵀAᵀy + xᵀAᵀA x.
        let explained: f64 =
            (0..UNKNOWNS).map(|i| x[i] * (2.0 * sums[i][UNKNOWNS] - (0..UNKNOWNS).map(|j| sums[i][j] * x[j]).sum::<f64>())).sum();
        found.error -= explained / (3.0 * n);
    }
    found
}

/// Quadratic form that pulls a sky toward the nearest multiple of a likely one `m`: `D − D m mᵀ D / mᵀ D m`, and a little toward 0. Likely is an
/// even radiance, or where there is no sun, 1 + 2 sin h as that of the CIE overcast sky (Moon and Spencer 1942).
fn likely(is_overcast: bool) -> [[f64; 9]; 9] {
    let of_zenith = radiances(Vec3::Z).map(f64::from);
    let mut other = [0.0; 9];
    other[0] = 1.0 / of_zenith[0];
    other[2] = if is_overcast { 2.0 / of_zenith[2] } else { 0.0 };
    let pull = BAND.map(|band| SKY_RIDGE[band]);
    let along: [f64; 9] = std::array::from_fn(|i| pull[i] * other[i]);
    let all: f64 = along.iter().zip(other).map(|(a, m)| a * m).sum();
    let own = |i: usize, j: usize| if i == j { pull[i] + SKY_LEAST } else { 0.0 };
    std::array::from_fn(|i| std::array::from_fn(|j| own(i, j) - along[i] * along[j] / all))
}

/// Solution of symmetric equations in which some unknowns are 0, by elimination.
fn without(equations: &[[f64; UNKNOWNS + 1]; UNKNOWNS], out: &[usize]) -> [f64; UNKNOWNS] {
    let mut m = *equations;
    for &i in out {
        m[i] = [0.0; UNKNOWNS + 1];
        m.iter_mut().for_each(|row| row[i] = 0.0);
        m[i][i] = 1.0;
    }
    for i in 0..UNKNOWNS {
        let pivot = m[i];
        for row in &mut m[i + 1..] {
            let factor = row[i] / pivot[i];
            (i..=UNKNOWNS).for_each(|j| row[j] -= factor * pivot[j]);
        }
    }
    let mut x = [0.0; UNKNOWNS];
    for i in (0..UNKNOWNS).rev() {
        x[i] = (m[i][UNKNOWNS] - (i + 1..UNKNOWNS).map(|j| m[i][j] * x[j]).sum::<f64>()) / m[i][i];
    }
    x
}
