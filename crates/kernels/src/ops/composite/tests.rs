use super::cases::scene;
use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, random_unit, wide};

#[test]
fn matches_the_reference_both_ways_for_any_channel_count() {
    for case in cases::cases() {
        let (p, c, s) = (case.scene.packed(), case.channels, &case.scene);
        let out = cpu::forward(&p, &s.sigma, &case.features, c, &case.background);
        let (sd, fd, bd) = (wide(&s.sigma), wide(&case.features), wide(&case.background));
        let of = |what| format!("{what}, R={} C={c}", case.rays);
        let want = reference::forward(&p, &sd, &fd, c, &bd);
        assert_close(&of("color"), &out.color, &want.color, 1e-4);
        assert_close(&of("depth"), &out.depth, &want.depth, 1e-4);
        assert_close(&of("opacity"), &out.opacity, &want.opacity, 1e-4);
        assert_close(&of("weights"), &out.weights, &want.weights, 1e-4);
        let [color, depth, opacity, weights] = case.d.each_ref().map(|v| Some(&v[..]));
        let g = cpu::backward(&p, &s.sigma, &case.features, c, &case.background, &cpu::Upstream { color, depth, opacity, weights });
        let [color, depth, opacity, weights] = case.d.each_ref().map(|v| wide(v));
        let (ds, df, db) = reference::backward(&p, &sd, &fd, c, &bd, &Composited { color, depth, opacity, weights });
        assert_close(&of("sigma"), &g.sigma, &ds, 1e-4);
        assert_close(&of("features"), &g.features, &df, 1e-4);
        assert_close(&of("background"), &g.background, &db, 1e-4);
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let s = scene(4, 9);
    let (n, c) = (s.t.len(), 2);
    let (sigma, f, b) = (wide(&s.sigma), wide(&random(n * c, 1)), wide(&random(4 * c, 2)));
    let d = Composited {
        color: wide(&random(4 * c, 3)),
        depth: wide(&random(4, 4)),
        opacity: wide(&random(4, 5)),
        weights: wide(&random(n, 6)),
    };
    let loss = |s: &[f64], f: &[f64], b: &[f64], p: &Packed| {
        let o = reference::forward(p, s, f, c, b);
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        dot(&o.color, &d.color) + dot(&o.depth, &d.depth) + dot(&o.opacity, &d.opacity) + dot(&o.weights, &d.weights)
    };
    let p = s.packed();
    let (ds, df, db) = reference::backward(&p, &sigma, &f, c, &b, &d);
    assert_gradient("sigma", &ds, &sigma, 1e-5, |x| loss(x, &f, &b, &p));
    assert_gradient("features", &df, &f, 1e-5, |x| loss(&sigma, x, &b, &p));
    assert_gradient("background", &db, &b, 1e-5, |x| loss(&sigma, &f, x, &p));
}

#[test]
fn weights_sum_to_the_opacity_and_a_wall_hides_what_is_behind() {
    let s = scene(60, 5);
    let out = cpu::forward(&s.packed(), &s.sigma, &vec![1.0; s.t.len()], 1, &vec![1.0; 60]);
    for r in 0..60 {
        let sum: f32 = out.weights[s.packed().range(r)].iter().sum();
        assert!((sum - out.opacity[r]).abs() < 1e-5 && (0.0..=1.0 + 1e-6).contains(&sum));
        // White furnace: everything radiates 1, so does the pixel.
        assert!((out.color[r] - 1.0).abs() < 1e-5);
    }
    let (t, dt, offsets) = ([1.0, 2.0], [0.5, 0.5], [0, 2]);
    let p = Packed { offsets: &offsets, t: &t, dt: &dt };
    let wall = cpu::forward(&p, &[1e4, 5.0], &[0.25, 9.0], 1, &[7.0]);
    assert!((wall.color[0] - 0.25).abs() < 1e-6);
}

#[test]
fn transmittance_and_split_match_the_reference_and_each_other() {
    let s = scene(40, 8);
    let p = s.packed();
    let (f, tq) = (random(s.t.len() * 3, 1), random_unit(40, 2).iter().map(|v| v * 4.0).collect::<Vec<f32>>());
    let (sd, fd, td) = (wide(&s.sigma), wide(&f), wide(&tq));
    assert_close("transmittance", &cpu::transmittance_at(&p, &s.sigma, &tq), &reference::transmittance_at(&p, &sd, &td), 1e-4);
    let (front, between, back) = cpu::split(&p, &s.sigma, &f, 3, &tq);
    let (rf, rt, rb) = reference::split(&p, &sd, &fd, 3, &td);
    assert_close("front", &front, &rf, 1e-4);
    assert_close("between", &between, &rt, 1e-4);
    assert_close("back", &back, &rb, 1e-4);
    let whole = cpu::forward(&p, &s.sigma, &f, 3, &vec![0.0; 120]);
    let joined: Vec<f64> = (0..120).map(|i| (front[i] + between[i / 3] * back[i]) as f64).collect();
    assert_close("front + T back", &whole.color, &joined, 1e-4);
}
