use super::*;
use diorama_geom::Lens;
use diorama_testkit::{assert_close, assert_gradient, random, random_unit, wide};

fn cameras() -> Vec<PosedCamera> {
    let lens = [
        Lens::Pinhole,
        Lens::Brown { k: [0.05, -0.02, 0.0, 0.0, 0.0, 0.0], p: [1e-3, -1e-3] },
        Lens::Fisheye { k: [0.02, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 2] },
    ];
    lens.into_iter()
        .enumerate()
        .map(|(i, lens)| PosedCamera {
            camera: Camera { lens, ..Camera::pinhole(64, 48, 0.9) },
            pose: Pose::look_at(DVec3::new(2.0, i as f64, 1.0), DVec3::ZERO, DVec3::Z),
        })
        .collect()
}

fn rays(n: usize) -> (Vec<u32>, Vec<f32>) {
    ((0..n as u32).map(|i| i % 3).collect(), random_unit(n * 2, 1).iter().map(|v| v * 48.0).collect())
}

#[test]
fn matches_the_reference_both_ways() {
    for n in [0, 1, 300] {
        let (c, (index, pixels)) = (cameras(), rays(n));
        let (mut o, mut d) = (vec![9.0; n * 3], vec![9.0; n * 3]);
        cpu::forward(&c, &index, &pixels, &mut o, &mut d);
        let (ro, rd) = reference::forward(&c, &index, &wide(&pixels));
        assert_close("origins", &o, &ro, 1e-5);
        assert_close("dirs", &d, &rd, 1e-5);
        let (go, gd) = (random(n * 3, 2), random(n * 3, 3));
        let mut g = vec![0.0; 21];
        cpu::backward(&c, &index, &pixels, &d, &go, &gd, &mut g);
        let g: Vec<f32> = g.iter().map(|v| *v as f32).collect();
        assert_close("corrections", &g, &reference::backward(&c, &index, &wide(&pixels), &wide(&go), &wide(&gd)), 1e-4);
    }
}

#[test]
fn reference_gradient_matches_central_differences_of_corrected_cameras() {
    let (c, (index, pixels)) = (cameras(), rays(12));
    let pixels = wide(&pixels);
    let (go, gd) = (wide(&random(36, 2)), wide(&random(36, 3)));
    let g = reference::backward(&c, &index, &pixels, &go, &gd);
    assert_gradient("corrections", &g, &[0.0; 21], 1e-5, |x| {
        let moved: Vec<PosedCamera> = c.iter().zip(x.chunks_exact(7)).map(|(c, d)| c.corrected(d.try_into().unwrap())).collect();
        let (o, d) = reference::forward(&moved, &index, &pixels);
        o.iter().zip(&go).chain(d.iter().zip(&gd)).map(|(a, b)| a * b).sum()
    });
}
