//! Properties of compositing and of the samples that it takes: what holds for every field, and what the order of rays may not change.

use diorama_kernels::ops::composite::cpu::{Upstream, backward, forward};
use diorama_kernels::ops::composite::{Composited, Packed};
use diorama_kernels::ops::sample_pdf;
use proptest::prelude::*;

/// Samples of some rays, with 3 channels.
#[derive(Clone, Debug)]
struct Rays {
    /// Per ray: (density, length, channels) of its samples, and its background.
    rays: Vec<(Vec<(f32, f32, [f32; 3])>, [f32; 3])>,
}

/// The same, packed.
struct Arrays {
    offsets: Vec<u32>,
    t: Vec<f32>,
    dt: Vec<f32>,
    sigma: Vec<f32>,
    features: Vec<f32>,
    background: Vec<f32>,
}

impl Rays {
    fn packed(&self) -> Arrays {
        let mut a =
            Arrays { offsets: vec![0], t: Vec::new(), dt: Vec::new(), sigma: Vec::new(), features: Vec::new(), background: Vec::new() };
        for (samples, back) in &self.rays {
            let mut t = 0.5;
            for (sigma, dt, color) in samples {
                a.t.push(t);
                a.dt.push(*dt);
                a.sigma.push(*sigma);
                a.features.extend(color);
                t += dt;
            }
            a.offsets.push(a.t.len() as u32);
            a.background.extend(back);
        }
        a
    }

    fn composited(&self) -> Composited<f32> {
        let a = self.packed();
        forward(&Packed { offsets: &a.offsets, t: &a.t, dt: &a.dt }, &a.sigma, &a.features, 3, &a.background)
    }

    /// Gradients of the densities where every color counts once.
    fn d_sigma(&self) -> Vec<f32> {
        let a = self.packed();
        let ones = vec![1.0; self.rays.len() * 3];
        let d = Upstream { color: Some(&ones), ..Upstream::default() };
        backward(&Packed { offsets: &a.offsets, t: &a.t, dt: &a.dt }, &a.sigma, &a.features, 3, &a.background, &d).sigma
    }
}

fn color() -> impl Strategy<Value = [f32; 3]> {
    prop::array::uniform3(0.0..1.0f32)
}

/// From no ray to more than one task of them, from none to many samples each, from clear to opaque.
fn rays() -> impl Strategy<Value = Rays> {
    let sigma = prop_oneof![4 => 0.0..5.0f32, 1 => Just(0.0f32), 1 => 1e2..1e6f32];
    let sample = (sigma, 1e-3..0.5f32, color());
    prop::collection::vec((prop::collection::vec(sample, 0..20), color()), 0..90).prop_map(|rays| Rays { rays })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn weights_are_shares_of_the_light_and_what_is_left_never_grows(r in rays()) {
        let out = r.composited();
        let mut at = 0;
        for (ray, (samples, _)) in r.rays.iter().enumerate() {
            let weights = &out.weights[at..at + samples.len()];
            at += samples.len();
            let mut left = 1.0f32;
            for w in weights {
                prop_assert!(*w >= 0.0 && left - w <= left);
                left -= w;
            }
            let sum: f64 = weights.iter().map(|w| *w as f64).sum();
            prop_assert!(sum <= 1.0 + 1e-5, "{sum}");
            prop_assert!((sum - out.opacity[ray] as f64).abs() < 1e-5, "{sum} {}", out.opacity[ray]);
        }
    }

    #[test]
    fn more_matter_lets_less_light_through(r in rays(), pick in any::<prop::sample::Index>(), more in 0.0..10.0f32) {
        let samples: Vec<(usize, usize)> = r.rays.iter().enumerate().flat_map(|(i, s)| (0..s.0.len()).map(move |k| (i, k))).collect();
        prop_assume!(!samples.is_empty());
        let (ray, k) = samples[pick.index(samples.len())];
        let mut denser = r.clone();
        denser.rays[ray].0[k].0 += more;
        let (before, after) = (r.composited(), denser.composited());
        prop_assert!(after.opacity[ray] >= before.opacity[ray] - 1e-6);
        // What stands before the sample does not know of it.
        let first: usize = r.rays[..ray].iter().map(|r| r.0.len()).sum();
        prop_assert_eq!(&before.weights[..first + k], &after.weights[..first + k]);
    }

    #[test]
    fn the_order_of_rays_changes_nothing(r in rays(), seed in any::<u64>()) {
        let n = r.rays.len();
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by_key(|i| (*i as u64 + 1).wrapping_mul(seed | 1).rotate_left(17));
        let turned = Rays { rays: order.iter().map(|i| r.rays[*i].clone()).collect() };
        let (a, b) = (r.composited(), turned.composited());
        let (da, db) = (r.d_sigma(), turned.d_sigma());
        let begins: Vec<usize> = r.rays.iter().scan(0, |at, s| Some(std::mem::replace(at, *at + s.0.len()))).collect();
        let mut at = 0;
        for (to, from) in order.into_iter().enumerate() {
            prop_assert_eq!(&a.color[from * 3..from * 3 + 3], &b.color[to * 3..to * 3 + 3]);
            prop_assert_eq!((a.depth[from], a.opacity[from]), (b.depth[to], b.opacity[to]));
            let k = r.rays[from].0.len();
            prop_assert_eq!(&a.weights[begins[from]..begins[from] + k], &b.weights[at..at + k]);
            prop_assert_eq!(&da[begins[from]..begins[from] + k], &db[at..at + k]);
            at += k;
        }
    }

    #[test]
    fn a_sample_that_is_divided_shows_the_same(r in rays()) {
        let halves = |(sigma, dt, color): &(f32, f32, [f32; 3])| [(*sigma, 0.5 * dt, *color), (*sigma, 0.5 * dt, *color)];
        let fine = Rays { rays: r.rays.iter().map(|(s, b)| (s.iter().flat_map(halves).collect(), *b)).collect() };
        let (a, b) = (r.composited(), fine.composited());
        for (x, y) in a.color.iter().chain(&a.opacity).zip(b.color.iter().chain(&b.opacity)) {
            prop_assert!((x - y).abs() < 1e-4, "{x} {y}");
        }
    }

    #[test]
    fn drawn_samples_are_ordered_and_lie_where_weights_are(
        lengths in prop::collection::vec(0.01..1.0f32, 1..20),
        weights in prop::collection::vec(0.0..1.0f32, 20),
        mut u in prop::collection::vec(0.0..0.999f32, 1..30),
    ) {
        let n = lengths.len();
        let mut edges = vec![0.25f32];
        lengths.iter().for_each(|l| edges.push(edges[edges.len() - 1] + l));
        u.sort_by(f32::total_cmp);
        let mut out = vec![0.0; u.len()];
        sample_pdf::cpu::sample(n, &edges, &weights[..n], u.len(), &u, &mut out);
        prop_assert!(out.windows(2).all(|w| w[0] <= w[1]), "{out:?}");
        prop_assert!(out.iter().all(|t| (edges[0]..=edges[n]).contains(t)), "{out:?}");
    }
}
