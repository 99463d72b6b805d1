use super::*;
use crate::gemm::has_bf16;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

fn cases() -> Vec<Matmul> {
    let mut all = Vec::new();
    for (batch, m, n, k) in [
        (0, 3, 4, 5),
        (2, 0, 4, 5),
        (2, 3, 4, 0),
        (1, 1, 1, 1),
        (3, 7, 5, 9),
        (2, 50, 50, 64),
        (1, 101, 150, 300),
        (1, 9, 48, 600),
        (1, 200, 33, 17),
        (1, 20, 33, 4500),
    ] {
        for flags in 0..8 {
            let [a_transposed, b_transposed, accumulate] = [1, 2, 4].map(|b| flags & b > 0);
            all.push(Matmul { batch, a_transposed, b_transposed, accumulate, ..Matmul::new(m, n, k) });
        }
    }
    all
}

#[test]
fn every_shape_matches_the_reference_both_ways_on_every_level() {
    for level in Level::available() {
        with_level(level, || cases().iter().for_each(check));
    }
}

fn check(s: &Matmul) {
    let (a, b, d) = (random(s.batch * s.m * s.k, 1), random(s.batch * s.k * s.n, 2), random(s.batch * s.m * s.n, 3));
    let mut c = d.clone();
    let mut want = wide(&d);
    cpu::matmul(s, &a, &b, &mut c);
    reference::forward(s, &wide(&a), &wide(&b), &mut want);
    assert_close(&format!("{s:?}"), &c, &want, 1e-5);
    let (ra, rb) = reference::backward(s, &wide(&a), &wide(&b), &wide(&d));
    let (mut da, mut db) = (vec![9.0; a.len()], vec![9.0; b.len()]);
    let (first, second) = if s.a_transposed { (&b, &d) } else { (&d, &b) };
    cpu::matmul(&s.gradient_a(), first, second, &mut da);
    assert_close(&format!("a's gradient of {s:?}"), &da, &ra, 1e-5);
    let (first, second) = if s.b_transposed { (&d, &a) } else { (&a, &d) };
    cpu::matmul(&s.gradient_b(), first, second, &mut db);
    assert_close(&format!("b's gradient of {s:?}"), &db, &rb, 1e-5);
}

#[test]
fn reference_gradients_match_central_differences() {
    for s in [Matmul { batch: 2, ..Matmul::new(3, 2, 4) }, Matmul { a_transposed: true, b_transposed: true, ..Matmul::new(2, 3, 2) }] {
        let (a, b) = (wide(&random(s.batch * s.m * s.k, 1)), wide(&random(s.batch * s.k * s.n, 2)));
        let d = wide(&random(s.batch * s.m * s.n, 3));
        let loss = |a: &[f64], b: &[f64]| {
            let mut c = vec![0.0; d.len()];
            reference::forward(&s, a, b, &mut c);
            c.iter().zip(&d).map(|(a, b)| a * b).sum::<f64>()
        };
        let (da, db) = reference::backward(&s, &a, &b, &d);
        assert_gradient("a", &da, &a, 1e-6, |a| loss(a, &b));
        assert_gradient("b", &db, &b, 1e-6, |b| loss(&a, b));
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads_and_finish_sees_every_output_once() {
    for s in [Matmul::new(130, 100, 700), Matmul::new(9, 50, 5000), Matmul::new(3, 4, 0)] {
        let (a, b) = (random(s.m * s.k, 1), random(s.k * s.n, 2));
        let run = |threads: usize| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
                let (mut c, mut finished) = (vec![9.0; s.m * s.n], vec![9.0; s.m * s.n]);
                cpu::matmul(&s, &a, &b, &mut c);
                let finish = |row: usize, column: usize, values: &mut [f32]| {
                    values.iter_mut().enumerate().for_each(|(i, v)| *v += (row * s.n + column + i) as f32);
                };
                cpu::matmul_with(&s, &a, &b, &mut finished, Some(&finish));
                assert!(finished.iter().zip(&c).enumerate().all(|(i, (f, c))| *f == c + i as f32), "{s:?}");
                c
            })
        };
        let one = run(1);
        assert!(one == run(2) && one == run(5), "{s:?}");
    }
}

#[test]
fn bf16_equals_the_product_of_rounded_factors() {
    if !has_bf16() {
        println!("no bf16 tiles here");
        return;
    }
    let round = |v: &[f32]| -> Vec<f64> { v.iter().map(|v| half::bf16::from_f32(*v).to_f64()).collect() };
    for s in cases().into_iter().map(|s| Matmul { precision: Precision::Bf16, ..s }) {
        let (a, b, mut c) = (random(s.batch * s.m * s.k, 1), random(s.batch * s.k * s.n, 2), random(s.batch * s.m * s.n, 3));
        let mut want = wide(&c);
        reference::forward(&s, &round(&a), &round(&b), &mut want);
        cpu::matmul(&s, &a, &b, &mut c);
        assert_close(&format!("{s:?}"), &c, &want, 1e-4);
    }
}
