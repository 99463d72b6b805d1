//! Depth supervision (after Deng et al. 2022, DS-NeRF): penalty on a ray's weights away from a surface of known distance, such as a
//! sparse point that the photograph shows. Per ray `Σ_i w_i · min(max(|m_i / d − 1| − 0.02, 0), 0.5)`, with weights `w`, the middles `m`
//! of the samples and the surface's distance `d`.
//!
//! It sums over weights instead of comparing their mean distance, so that fog before a surface costs as much as matter behind it.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;

/// Tolerated distance from the surface, as a share of its distance: sparse points are not exact.
pub const EXACT: f32 = 0.02;

/// Largest penalty: a wrong point must not outweigh the photographs.
pub const MOST: f32 = 0.5;

/// Penalty on light that ends at distance `middle` from the camera, where the surface is at `surface`.
#[inline(always)]
pub fn away(middle: f32, surface: f32) -> f32 {
    ((middle / surface - 1.0).abs() - EXACT).clamp(0.0, MOST)
}

/// Loss of a ray whose samples begin at `t`, are `dt` long and have weights `w`; adds `scale · ∂loss/∂w` to `g`.
pub fn ray(t: &[f32], dt: &[f32], w: &[f32], surface: f32, scale: f32, g: &mut [f32]) -> f32 {
    let mut loss = 0.0;
    for i in 0..w.len() {
        let away = away(t[i] + 0.5 * dt[i], surface);
        loss += away * w[i];
        g[i] += scale * away;
    }
    loss
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::composite::cases::scene;
    use diorama_testkit::{assert_close, assert_gradient, random_unit, wide};

    /// Distances of the surfaces of some rays; none for every third.
    fn surfaces(rays: usize) -> Vec<f32> {
        random_unit(rays, 8).iter().zip(0..).map(|(v, r)| if r % 3 == 2 { 0.0 } else { 0.2 + 2.0 * v }).collect()
    }

    #[test]
    fn matches_the_reference_both_ways() {
        for cases::Case { rays, scene: s, weights: w, surface } in cases::cases() {
            let (p, mut g) = (s.packed(), vec![0.0; w.len()]);
            let of = |r: usize| {
                let i = p.range(r);
                if surface[r] > 0.0 { ray(&p.t[i.clone()], &p.dt[i.clone()], &w[i.clone()], surface[r], 0.7, &mut g[i]) } else { 0.0 }
            };
            let loss: Vec<f32> = (0..rays).map(of).collect();
            let want = reference::forward(&p, &wide(&w), &surface);
            assert!(rays < 77 || want.iter().filter(|v| **v > 0.01).count() > 20, "{want:?}");
            assert_close("loss", &loss, &want, 1e-5);
            assert_close("weights", &g, &reference::backward(&p, &surface, 0.7), 1e-5);
        }
    }

    #[test]
    fn reference_gradient_matches_central_differences() {
        let s = scene(4, 6);
        let (p, w, surface) = (s.packed(), wide(&random_unit(s.t.len(), 1)), surfaces(4));
        assert_gradient("weights", &reference::backward(&p, &surface, 1.0), &w, 1e-5, |w| reference::forward(&p, w, &surface).iter().sum());
    }

    #[test]
    fn light_counts_before_and_behind_the_surface_and_not_at_it() {
        let cases = [(2.0, 0.0), (2.03, 0.0), (2.2, 0.08), (1.8, 0.08), (0.2, 0.5), (90.0, 0.5)];
        for (middle, expected) in cases {
            assert!((away(middle, 2.0) - expected).abs() < 1e-6, "{middle}: {}", away(middle, 2.0));
        }
    }

    #[test]
    fn the_gradient_is_the_slope_of_the_loss() {
        let (t, dt, w) = ([0.5, 1.9, 3.0], [0.1, 0.2, 0.4], [0.2f32, 0.5, 0.1]);
        let mut g = [1.0; 3];
        let loss = ray(&t, &dt, &w, 2.0, 3.0, &mut g);
        for i in 0..3 {
            let mut more = w;
            more[i] += 0.25;
            let slope = (ray(&t, &dt, &more, 2.0, 3.0, &mut [0.0; 3]) - loss) / 0.25;
            assert!((g[i] - 1.0 - 3.0 * slope).abs() < 1e-5, "{i}: {} {slope}", g[i]);
        }
        assert!((loss - (0.2 * MOST + 0.1 * MOST)).abs() < 1e-6, "{loss}");
    }
}
