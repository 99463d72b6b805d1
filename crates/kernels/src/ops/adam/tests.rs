use super::*;
use diorama_testkit::{assert_close, random, wide};

#[test]
fn dense_matches_the_reference() {
    for c in cases::cases().into_iter().filter(|c| !c.sparse) {
        let (n, own) = (c.params.len(), &c.range);
        let (mut p, mut m, mut v) = (c.params.clone(), vec![0.0; n], vec![0.0; n]);
        let (mut pr, mut mr, mut vr) = (wide(&p), wide(&m), wide(&v));
        for (t, g) in (1..).zip(&c.gradients) {
            let (p, m, v) = (&mut p[own.clone()], &mut m[own.clone()], &mut v[own.clone()]);
            cpu::dense(&c.adam, t, p, m, v, &g[own.clone()]);
            let (pr, mr, vr) = (&mut pr[own.clone()], &mut mr[own.clone()], &mut vr[own.clone()]);
            reference::step(&c.adam, t, false, pr, mr, vr, &wide(&g[own.clone()]));
        }
        assert_close("p", &p, &pr, 1e-4);
        assert_close("m", &m, &mr, 1e-4);
        assert_close("v", &v, &vr, 1e-4);
    }
}

#[test]
fn sparse_matches_the_reference_and_clears_what_it_used() {
    let n = cpu::LINE * 5000;
    let a = Adam { weight_decay: 1e-2, ..Adam::default() };
    let (mut p, mut m, mut v) = (random(n, 1), vec![0.0; n], vec![0.0; n]);
    let (mut pr, mut mr, mut vr) = (wide(&p), wide(&m), wide(&v));
    for t in 1..4u32 {
        let mut g = random(n, 10 + t as u64);
        let mut touched = vec![0u8; n / cpu::LINE];
        for (line, mark) in touched.iter_mut().enumerate() {
            let live = line as u32 % 3 != t % 3;
            *mark = live as u8;
            for (i, g) in g[line * cpu::LINE..(line + 1) * cpu::LINE].iter_mut().enumerate() {
                if !live || i % 4 == 0 {
                    *g = 0.0;
                }
            }
        }
        reference::step(&a, t, true, &mut pr, &mut mr, &mut vr, &wide(&g));
        cpu::sparse(&a, t, &mut p, &mut m, &mut v, &mut g, &mut touched);
        assert!(g.iter().all(|g| *g == 0.0) && touched.iter().all(|t| *t == 0));
    }
    assert_close("p", &p, &pr, 1e-4);
    assert_close("m", &m, &mr, 1e-4);
    assert_close("v", &v, &vr, 1e-4);
}

#[test]
fn it_converges_to_the_minimum() {
    let (mut p, mut m, mut v) = (vec![5.0f32], vec![0.0], vec![0.0]);
    let a = Adam { rate: 0.1, ..Adam::default() };
    for t in 1..400 {
        let g = [2.0 * (p[0] - 1.5)];
        cpu::dense(&a, t, &mut p, &mut m, &mut v, &g);
    }
    assert!((p[0] - 1.5).abs() < 1e-2, "{p:?}");
}
