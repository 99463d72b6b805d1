use super::*;
use crate::simd::{Level as Simd, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, random_unit, wide};

struct Case {
    texture: Texture,
    texels: Vec<f32>,
    coordinates: Vec<f32>,
    level: Vec<f32>,
    d: Vec<f32>,
}

const KINDS: [Kind; 3] = [Kind::Repeat, Kind::Clamp, Kind::Cube];
const FILTERS: [Filter; 3] = [Filter::Nearest, Filter::Bilinear, Filter::Trilinear];

fn case(texture: Texture, points: usize, seed: u64) -> Case {
    let n = texture.coordinates();
    let spread = if texture.kind == Kind::Cube { |v: f32| v } else { |v: f32| 2.0 * v + 0.5 };
    let most = texture.levels().len() as f32;
    let level = if texture.filter == Filter::Trilinear { random_unit(points, seed + 3) } else { vec![] };
    Case {
        texels: random(texture.numbers(), seed),
        coordinates: random(points * n, seed + 1).into_iter().map(spread).collect(),
        // Some below the finest level and beyond the coarsest.
        level: level.into_iter().map(|l| l * (most + 1.0) - 1.0).collect(),
        d: random(points * texture.channels, seed + 2),
        texture,
    }
}

fn cases() -> Vec<Case> {
    let mut all = Vec::new();
    for kind in KINDS {
        for filter in FILTERS {
            let of = |images, size, channels| Texture { kind, filter, images, size, channels };
            let shapes: &[(Texture, usize)] = if kind == Kind::Cube {
                &[
                    (of(1, [8, 8], 3), 500),
                    (of(2, [4, 4], 1), 300),
                    (of(1, [1, 1], 2), 100),
                    (of(1, [3, 3], 6), 400),
                    (of(1, [24, 24], 3), 700),
                ]
            } else {
                &[
                    (of(1, [8, 8], 3), 0),
                    (of(1, [16, 8], 3), 500),
                    (of(3, [12, 20], 4), 300),
                    (of(1, [1, 8], 1), 100),
                    (of(1, [5, 7], 9), 200),
                    (of(2, [64, 64], 2), 1000),
                ]
            };
            all.extend(shapes.iter().map(|(texture, points)| case(*texture, *points, 5)));
        }
    }
    all
}

#[test]
fn matches_the_reference_both_ways_at_every_level() {
    for simd in Simd::available() {
        for c in cases() {
            let (t, name) = (&c.texture, format!("{:?}", c.texture));
            let (mut out, mut d_texels) = (vec![9.0; c.d.len()], vec![9.0; c.texels.len()]);
            let (mut d_coordinates, mut d_level) = (vec![9.0; c.coordinates.len()], vec![9.0; c.level.len()]);
            with_level(simd, || {
                cpu::forward(t, &c.texels, &c.coordinates, &c.level, &mut out);
                cpu::backward_texels(t, &c.coordinates, &c.level, &c.d, &mut d_texels);
                cpu::backward_coordinates(t, &c.texels, &c.coordinates, &c.level, &c.d, &mut d_coordinates, &mut d_level);
            });
            let (texels, coordinates, level) = (wide(&c.texels), wide(&c.coordinates), wide(&c.level));
            assert_close(&name, &out, &reference::forward(t, &texels, &coordinates, &level), 2e-5);
            let (want_texels, want_coordinates, want_level) = reference::backward(t, &texels, &coordinates, &level, &wide(&c.d));
            assert_close(&name, &d_texels, &want_texels, 1e-4);
            assert_close(&name, &d_coordinates, &want_coordinates, 1e-4);
            assert_close(&name, &d_level, &want_level, 1e-4);
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for kind in KINDS {
        for filter in FILTERS {
            let c = case(Texture { kind, filter, images: 2, size: [4, 4], channels: 2 }, 14, 9);
            let (t, name) = (&c.texture, format!("{:?}", c.texture));
            let (texels, coordinates, level, d) = (wide(&c.texels), wide(&c.coordinates), wide(&c.level), wide(&c.d));
            let loss = |texels: &[f64], coordinates: &[f64], level: &[f64]| {
                reference::forward(t, texels, coordinates, level).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>()
            };
            let (d_texels, d_coordinates, d_level) = reference::backward(t, &texels, &coordinates, &level, &d);
            assert_gradient(&name, &d_texels, &texels, 1e-6, |texels| loss(texels, &coordinates, &level));
            assert_gradient(&name, &d_coordinates, &coordinates, 1e-5, |coordinates| loss(&texels, coordinates, &level));
            assert_gradient(&name, &d_level, &level, 1e-6, |level| loss(&texels, &coordinates, level));
        }
    }
}

#[test]
fn large_textures_get_their_gradient_by_ranges() {
    for (kind, filter) in [(Kind::Repeat, Filter::Trilinear), (Kind::Clamp, Filter::Bilinear), (Kind::Cube, Filter::Trilinear)] {
        let c = case(Texture { kind, filter, images: 2, size: [64, 64], channels: 3 }, 20_000, 3);
        let (texels, coordinates, level) = (wide(&c.texels), wide(&c.coordinates), wide(&c.level));
        let mut got = vec![9.0; c.texels.len()];
        cpu::backward_texels(&c.texture, &c.coordinates, &c.level, &c.d, &mut got);
        assert_close("texels", &got, &reference::backward(&c.texture, &texels, &coordinates, &level, &wide(&c.d)).0, 1e-3);
        for size in [[64, 64], [8, 8]] {
            // Sorted by ranges, and in copies.
            let c = case(Texture { size, ..c.texture }, 20_000, 3);
            let with = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let mut got = vec![9.0; c.texels.len()];
                pool.install(|| cpu::backward_texels(&c.texture, &c.coordinates, &c.level, &c.d, &mut got));
                got
            };
            assert_eq!(with(1), with(3));
        }
    }
}

#[test]
fn texels_are_where_the_conventions_say() {
    let texels = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
    for filter in [Filter::Nearest, Filter::Bilinear] {
        let t = Texture { kind: Kind::Repeat, filter, images: 1, size: [2, 3], channels: 1 };
        // Centers of the second and the last texel, and of the first one of the next repetition.
        let at = [0.5, 0.25, 2.5 / 3.0, 0.75, 1.0 + 0.5 / 3.0, -0.75];
        let mut out = [0.0; 3];
        cpu::forward(&t, &texels, &at, &[], &mut out);
        assert_close("centers", &out, &[2.0, 6.0, 1.0], 1e-5);
        cpu::forward(&Texture { kind: Kind::Clamp, ..t }, &texels, &[-5.0, 0.25, 5.0, 0.25, 0.5, 9.0], &[], &mut out);
        assert_close("borders", &out, &[1.0, 3.0, 5.0], 1e-5);
    }
    // A face's number in each texel of a cube: the faces in their order, and s and t as OpenGL turns them.
    let t = Texture { kind: Kind::Cube, filter: Filter::Nearest, images: 1, size: [2, 2], channels: 1 };
    let numbers: Vec<f32> = (0..24).map(|i| i as f32).collect();
    let mut out = [0.0; 8];
    let at = [
        [9.0, 0.1, 0.2],
        [-9.0, 0.1, 0.2],
        [0.1, 9.0, 0.2],
        [0.1, -9.0, 0.2],
        [0.1, 0.2, 9.0],
        [0.1, 0.2, -9.0],
        [9.0, 1.0, -1.0],
        [9.0, -1.0, 1.0],
    ];
    cpu::forward(&t, &numbers, at.as_flattened(), &[], &mut out);
    assert_eq!(out, [0.0, 5.0, 11.0, 13.0, 17.0, 20.0, 1.0, 2.0]);
}

#[test]
fn cube_maps_have_no_seams() {
    for size in [1, 2, 3, 8] {
        let t = Texture { kind: Kind::Cube, filter: Filter::Bilinear, images: 1, size: [size; 2], channels: 1 };
        let texels = random(t.numbers(), 4);
        let at = |d: [f32; 3]| {
            let mut out = [0.0];
            cpu::forward(&t, &texels, &d, &[], &mut out);
            out[0]
        };
        let mut largest = 0.0f32;
        for (i, place) in random(3000, 8).into_iter().enumerate() {
            // A point of an edge, or near a corner, from both sides.
            let (a, b, c) = (i % 3, (i + 1) % 3, (i + 2) % 3);
            let mut d = [0.0; 3];
            d[a] = if i % 2 == 0 { 1.0 } else { -1.0 };
            d[b] = if i / 6 % 2 == 0 { 1.0 } else { -1.0 };
            d[c] = if i / 12 % 4 == 0 { (1.0 - 1e-3 * place.abs()).copysign(place) } else { place };
            let (mut inner, mut outer) = (d, d);
            inner[a] *= 1.0 - 1e-6;
            outer[a] *= 1.0 + 1e-6;
            largest = largest.max((at(inner) - at(outer)).abs());
        }
        assert!(largest < 1e-4, "{size}: {largest}");
        // At a corner, the three texels around it weigh the same.
        let mean = |corners: [usize; 3]| corners.iter().map(|i| texels[*i]).sum::<f32>() / 3.0;
        let n = size * size;
        // +x meets +y and +z at its top left corner; +y has it at its bottom right, +z at its top right one.
        assert!((at([1.0, 1.0, 1.0]) - mean([0, 3 * n - 1, 4 * n + size - 1])).abs() < 1e-5, "{size}");
    }
}

#[test]
fn levels_are_means_and_their_gradients_go_back() {
    let shapes = [(Kind::Repeat, [8, 8]), (Kind::Clamp, [4, 12]), (Kind::Repeat, [1, 4]), (Kind::Clamp, [5, 4]), (Kind::Cube, [4, 4])];
    for (kind, size) in shapes {
        let t = Texture { kind, filter: Filter::Trilinear, images: 2, size, channels: 3 };
        let finest = 2 * t.faces() * size[0] * size[1] * 3;
        let mut texels = random(t.numbers(), 1);
        let want = reference::mips(&t, &wide(&texels[..finest]));
        mips::forward(&t, &mut texels);
        assert_close("levels", &texels, &want, 1e-6);
        // <levels(x), d> = <x, backward(d)>.
        let d = random(texels.len(), 2);
        let mut back = d.clone();
        mips::backward(&t, &mut back);
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| *a as f64 * *b as f64).sum::<f64>();
        let (through, direct) = (dot(&texels, &d), dot(&texels[..finest], &back[..finest]));
        assert!((through - direct).abs() < 1e-4 * dot(&d, &d).sqrt(), "{size:?}: {through} {direct}");
    }
    let levels = |size| Texture { kind: Kind::Repeat, filter: Filter::Trilinear, images: 1, size, channels: 1 }.levels().len();
    assert_eq!((levels([8, 8]), levels([4, 12]), levels([5, 4]), levels([1, 1]), levels([0, 8])), (4, 3, 1, 1, 1));
}

#[test]
fn footprints_match_the_reference_and_their_gradients_central_differences() {
    for kind in KINDS {
        let t = Texture { kind, filter: Filter::Trilinear, images: 1, size: [16; 2], channels: 1 };
        let n = t.coordinates();
        let (coordinates, d_level) = (random(20 * n, 1), random(20, 3));
        let mut derivatives: Vec<f32> = random(40 * n, 2).iter().map(|v| 0.3 * v).collect();
        let (mut level, mut d_c, mut d_d) = (vec![9.0; 20], vec![9.0; 20 * n], vec![9.0; 40 * n]);
        let (c, d) = (wide(&coordinates), wide(&derivatives));
        footprint::forward(&t, &coordinates, &derivatives, &mut level);
        assert_close("levels", &level, &reference::footprint(&t, &c, &d), 1e-5);
        footprint::backward(&t, &coordinates, &derivatives, &d_level, &mut d_c, &mut d_d);
        let loss = |c: &[f64], d: &[f64]| reference::footprint(&t, c, d).iter().zip(&d_level).map(|(a, b)| a * *b as f64).sum::<f64>();
        assert_gradient("derivatives", &wide(&d_d), &d, 1e-4, |d| loss(&c, d));
        assert_gradient("coordinates", &wide(&d_c), &c, 1e-4, |c| loss(c, &d));
        // No footprint has a finite level, and no gradient.
        derivatives.fill(0.0);
        footprint::forward(&t, &coordinates, &derivatives, &mut level);
        footprint::backward(&t, &coordinates, &derivatives, &d_level, &mut d_c, &mut d_d);
        assert!(level.iter().all(|l| *l == -20.0) && d_d.iter().chain(&d_c).all(|d| *d == 0.0));
    }
    // Two texels of 16 along each axis of a pixel are one level.
    let t = Texture { kind: Kind::Repeat, filter: Filter::Trilinear, images: 1, size: [16; 2], channels: 1 };
    let mut level = [0.0];
    footprint::forward(&t, &[0.3, 0.3], &[0.125, 0.0, 0.0, 0.125], &mut level);
    assert_eq!(level, [1.0]);
}

#[test]
fn coordinates_that_are_no_numbers_or_far_away_read_some_texel() {
    let odd = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 0.0, -1e-9, -0.0, 1.0];
    let coordinates: Vec<f32> = (0..9 * 9 * 9).flat_map(|i| [odd[i % 9], odd[i / 9 % 9], odd[i / 81]]).collect();
    for kind in KINDS {
        for filter in FILTERS {
            let t = Texture { kind, filter, images: 1, size: [4, 4], channels: 1 };
            let points = coordinates.len() / 3;
            let coordinates = &coordinates[..points * t.coordinates()];
            let level: Vec<f32> = if filter == Filter::Trilinear { (0..points).map(|i| odd[i % 7]).collect() } else { vec![] };
            let (mut out, mut d_texels) = (vec![0.0; points], vec![0.0; t.numbers()]);
            let (mut d_coordinates, mut d_level) = (vec![0.0; coordinates.len()], vec![0.0; level.len()]);
            let ones = vec![1.0; t.numbers()];
            for simd in Simd::available() {
                with_level(simd, || {
                    cpu::forward(&t, &ones, coordinates, &level, &mut out);
                    cpu::backward_texels(&t, coordinates, &level, &out, &mut d_texels);
                    cpu::backward_coordinates(&t, &ones, coordinates, &level, &out, &mut d_coordinates, &mut d_level);
                });
                assert!(out.iter().all(|v| (v - 1.0).abs() < 1e-5), "{t:?}");
            }
        }
    }
}

#[test]
#[should_panic(expected = "texture: texels of all levels")]
fn levels_that_are_not_there_are_refused() {
    let t = Texture { kind: Kind::Repeat, filter: Filter::Trilinear, images: 1, size: [4, 4], channels: 1 };
    cpu::forward(&t, &[0.0; 16], &[0.0; 2], &[0.0], &mut [0.0]);
}
