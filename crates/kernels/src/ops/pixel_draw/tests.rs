use super::*;
use diorama_testkit::{assert_close, wide};

#[test]
fn matches_the_reference() {
    for c in cases::cases() {
        let want = reference::draw(&c.source, &c.draw(), c.rays);
        let n = c.rays;
        let (mut images, mut pixels, mut target, mut jitter) = (vec![9; n], vec![9.0; n * 2], vec![9.0; n * 4], vec![9.0; n]);
        let (mut distance, mut counts) = (vec![9.0; n], vec![true; n]);
        let out = cpu::Drawn {
            images: &mut images,
            pixels: &mut pixels,
            target: &mut target,
            jitter: &mut jitter,
            distance: &mut distance,
            counts: &mut counts,
        };
        cpu::draw(&c.source, &c.draw(), out);
        let got: Vec<reference::Pixel> = (0..n)
            .map(|r| reference::Pixel {
                image: images[r],
                x: pixels[r * 2] as u32,
                y: pixels[r * 2 + 1] as u32,
                distance: distance[r],
                jitter: jitter[r],
                counts: counts[r],
            })
            .collect();
        assert_eq!(got, want, "stride {}", c.source.stride);
        let colors: Vec<f32> = want.iter().flat_map(|p| c.source.rgba(p.image as usize, p.x, p.y)).collect();
        assert_close("target", &target, &wide(&colors), 1e-6);
        if n > 100 {
            assert!(want.iter().any(|p| !p.counts), "masks refuse some draws five times over");
            assert_eq!(want.iter().any(|p| p.distance > 0.0), !c.observations.is_empty());
        }
    }
}
