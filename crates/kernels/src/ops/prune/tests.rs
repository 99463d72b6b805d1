use super::cases::{PRUNING, cases};
use super::*;
use diorama_testkit::assert_close;

#[test]
fn matches_the_reference() {
    for (rays, scene) in cases() {
        let (p, n) = (scene.packed(), scene.sigma.len());
        let (mut sigma, mut alpha, mut light, mut counts) = (scene.sigma.clone(), vec![9.0; n], vec![1.0; rays], vec![0; rays]);
        let samples =
            cpu::Samples { offsets: p.offsets, dt: p.dt, sigma: &mut sigma, alpha: &mut alpha, light: &mut light, counts: &mut counts };
        cpu::prune(&PRUNING, samples);
        let want = reference::prune(&PRUNING, &p, &scene.sigma);
        let kept: Vec<usize> = (0..n).filter(|i| alpha[*i] >= 0.0).collect();
        assert_eq!((&kept, &sigma), (&want.kept, &want.sigma));
        assert_eq!(counts, want.offsets.windows(2).map(|w| w[1] - w[0]).collect::<Vec<u32>>());
        assert_close("light", &light, &want.light, 1e-4);
        assert!(rays < 80 || (kept.len() > n / 10 && kept.len() < n * 9 / 10 && sigma.contains(&DROPPED)), "{} of {n}", kept.len());
    }
}

#[test]
fn each_limit_leaves_out_more() {
    let (_, scene) = &cases()[3];
    let kept = |pruning: Pruning| reference::prune(&pruning, &scene.packed(), &scene.sigma).kept.len();
    let none = Pruning { stop: 0.0, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 };
    assert_eq!(kept(none), scene.sigma.len());
    for more in [Pruning { stop: 0.1, ..none }, Pruning { min_alpha: 0.01, ..none }, Pruning { min_weight: 0.01, ..none }] {
        assert!(kept(more) < kept(none), "{more:?}");
    }
    // What is denser than `thin` stays however short its step.
    let thin = Pruning { min_alpha: 1.0, thin: 0.0, ..none };
    assert_eq!(kept(thin), kept(none));
}
