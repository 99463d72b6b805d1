use super::*;
use crate::ops::ray_triangles;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

/// A mesh in clip space and what it is drawn on.
struct Case {
    name: &'static str,
    raster: Rasterize,
    positions: Vec<f32>,
    triangles: Vec<[u32; 3]>,
}

/// Clip space of points before a camera: x right, y down, z forward, 90° wide, planes at 0.1 and 10.
fn project(points: &[[f32; 3]]) -> Vec<f32> {
    let (near, far) = (0.1f32, 10.0);
    let z = |z: f32| (z * (far + near) - 2.0 * far * near) / (far - near);
    points.iter().flat_map(|p| [p[0], p[1], z(p[2]), p[2]]).collect()
}

/// Triangles of edges of about `size` in the cube `[−1, 1]³` moved by `forward`.
fn soup(n: usize, size: f32, forward: f32, seed: u64) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let (centers, edges) = (random(3 * n, seed), random(9 * n, seed + 1));
    let at = |i: usize| std::array::from_fn(|k| centers[i / 3 * 3 + k] + size * edges[3 * i + k] + if k == 2 { forward } else { 0.0 });
    ((0..3 * n).map(at).collect(), (0..n as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect())
}

/// A grid of `n²` squares that share their vertices, bent at random.
fn sheet(n: usize, seed: u64) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let bend = random(3 * (n + 1) * (n + 1), seed);
    let at = |i: usize, k: usize| 0.3 / n as f32 * bend[3 * i + k];
    let vertex = |i: usize| {
        let (x, y) = (i % (n + 1), i / (n + 1));
        [2.0 * x as f32 / n as f32 - 1.0 + at(i, 0), 2.0 * y as f32 / n as f32 - 1.0 + at(i, 1), 1.5 + at(i, 2)]
    };
    let square = |i: usize| {
        let a = (i / n * (n + 1) + i % n) as u32;
        let b = a + n as u32 + 1;
        [[a, a + 1, b], [a + 1, b + 1, b]]
    };
    ((0..(n + 1) * (n + 1)).map(vertex).collect(), (0..n * n).flat_map(square).collect())
}

fn cases() -> Vec<Case> {
    let case = |name, size, (points, triangles): (Vec<[f32; 3]>, Vec<[u32; 3]>)| Case {
        name,
        raster: Rasterize { images: 1, vertices: points.len(), size },
        positions: project(&points),
        triangles,
    };
    let one = |z: [f32; 3]| (vec![[-0.7, -0.5, z[0]], [0.8, -0.3, z[1]], [0.1, 0.9, z[2]]], vec![[0, 1, 2]]);
    let mut two = case("two images", [33, 47], soup(40, 0.5, 1.5, 11));
    two.positions.extend(project(&soup(40, 0.5, 1.7, 13).0));
    two.raster.images = 2;
    vec![
        case("empty", [20, 30], (vec![], vec![])),
        case("no pixels", [0, 7], one([1.0; 3])),
        case("one pixel", [1, 1], one([1.0; 3])),
        case("one triangle", [64, 64], one([1.0, 1.2, 0.9])),
        case("seen from behind", [64, 64], (one([1.0, 1.2, 0.9]).0, vec![[0, 2, 1]])),
        case("behind the camera", [40, 40], one([-1.0, -1.2, -0.9])),
        case("across the near plane", [50, 70], one([-0.5, 1.0, 0.4])),
        case("two corners behind", [50, 70], one([0.8, -0.2, -0.5])),
        case("beyond the far plane", [50, 70], one([5.0, 14.0, 8.0])),
        case("odd size", [37, 101], soup(200, 0.4, 1.5, 5)),
        case("around the camera", [100, 100], soup(300, 0.5, 0.0, 7)),
        case("small triangles", [64, 90], soup(5000, 0.02, 1.5, 9)),
        case("sheet", [128, 128], sheet(20, 3)),
        two,
    ]
}

fn forward(c: &Case, derivatives: bool) -> Raster {
    let mut out = Raster::default();
    cpu::forward(&c.raster, &c.positions, &c.triangles, derivatives, &mut out);
    out
}

/// Pixels whose ids differ must be rare; the others must agree in everything.
fn compare(c: &Case, got: &Raster, want: &reference::Raster) -> usize {
    let differ = (0..got.ids.len()).filter(|p| got.ids[*p] != want.ids[*p]).count();
    let keep = |p: usize| if got.ids[p] == want.ids[p] { 1.0 } else { 0.0 };
    let mask = |v: &[f64], k: usize| -> Vec<f64> { v.iter().enumerate().map(|(i, v)| v * keep(i / k)).collect() };
    let narrow = |v: &[f32], k: usize| -> Vec<f32> { v.iter().enumerate().map(|(i, v)| v * keep(i / k) as f32).collect() };
    assert_close(c.name, &narrow(&got.uv, 2), &mask(&want.uv, 2), 1e-4);
    assert_close(c.name, &narrow(&got.depth, 1), &mask(&want.depth, 1), 1e-5);
    assert_close(c.name, &narrow(&got.derivatives, 4), &mask(&want.derivatives, 4), 1e-4);
    differ
}

#[test]
fn ids_and_barycentrics_match_brute_force_at_every_level() {
    for level in Level::available() {
        let (mut differ, mut covered) = (0, 0);
        for c in cases() {
            let want = reference::forward(&c.raster, &wide(&c.positions), &c.triangles, None);
            let got = with_level(level, || forward(&c, true));
            differ += compare(&c, &got, &want);
            covered += want.ids.iter().filter(|id| **id != 0).count();
        }
        assert!(covered > 20_000, "{covered}");
        println!("{level:?}: {differ} of {covered} pixels differ");
        assert!(differ * 10_000 <= covered, "{level:?}: {differ} of {covered} pixels differ");
    }
}

#[test]
fn what_a_case_shows_is_what_its_name_says() {
    let covered = |name: &str| {
        let c = cases().into_iter().find(|c| c.name == name).unwrap();
        forward(&c, false).ids.iter().filter(|id| **id != 0).count()
    };
    assert_eq!((covered("empty"), covered("behind the camera")), (0, 0));
    assert_eq!(covered("one triangle"), covered("seen from behind"));
    for name in ["across the near plane", "two corners behind", "beyond the far plane", "one pixel"] {
        assert!(covered(name) > 0, "{name}");
    }
}

#[test]
fn pixels_show_what_their_rays_hit() {
    // Another way to the same picture: rays through the pixels, of depths within the planes.
    for (mut points, triangles) in [soup(150, 0.6, 1.2, 21), soup(200, 0.7, 0.0, 23)] {
        let raster = Rasterize { images: 1, vertices: points.len(), size: [80, 80] };
        // Rays meet vertices where they are, so these are put on the grid.
        let on_grid = reference::snapped(&raster, &wide(&project(&points)));
        for (point, moved) in points.iter_mut().zip(on_grid.as_chunks::<4>().0) {
            (point[0], point[1]) = (moved[0] as f32, moved[1] as f32);
        }
        let c = Case { name: "rays", raster, positions: project(&points), triangles: triangles.clone() };
        let got = forward(&c, false);
        let mut differ = 0;
        for p in 0..80 * 80 {
            let ndc = |v: usize| (v as f32 + 0.5) / 40.0 - 1.0;
            let ray = ray_triangles::Ray { origin: [0.0; 3], direction: [ndc(p % 80), ndc(p / 80), 1.0], range: [0.1, 10.0] };
            let hit = ray_triangles::reference::nearest(&points, &triangles, &ray);
            differ += (got.ids[p] != hit.map_or(0, |h| h.1 + 1)) as usize;
            if let Some((_, id, [b, _])) = hit
                && got.ids[p] == id + 1
            {
                assert!((got.uv[2 * p + 1] as f64 - b).abs() < 1e-3, "v is the weight of the second corner");
            }
        }
        assert!(differ <= 1, "{differ}");
    }
}

#[test]
fn centers_on_shared_edges_belong_to_one_triangle() {
    // Corners on pixel centers, all diagonals through centers: every pixel inside is covered by one triangle, on its own or with others.
    let n = 8u32;
    let points: Vec<f32> = (0..(n + 1) * (n + 1))
        .flat_map(|i| {
            let at = |v: u32| (4.0 * v as f32 + 0.5) / 32.0 - 1.0;
            [at(i % (n + 1)), at(i / (n + 1)), 0.5, 1.0]
        })
        .collect();
    let square = |i: u32| {
        let a = i / n * (n + 1) + i % n;
        let b = a + n + 1;
        if i.is_multiple_of(3) { [[a, a + 1, b], [a + 1, b + 1, b]] } else { [[b + 1, a, a + 1], [a, b + 1, b]] }
    };
    let triangles: Vec<[u32; 3]> = (0..n * n).flat_map(square).collect();
    let raster = Rasterize { images: 1, vertices: 81, size: [64, 64] };
    for level in Level::available() {
        let mut times = vec![0; 4096];
        for t in &triangles {
            let mut out = Raster::default();
            with_level(level, || cpu::forward(&raster, &points, &[*t], false, &mut out));
            times.iter_mut().zip(&out.ids).for_each(|(n, id)| *n += (*id != 0) as u32);
        }
        for (p, n) in times.iter().enumerate() {
            let inside = p % 64 < 32 && p / 64 < 32;
            assert_eq!(*n, inside as u32, "pixel {p}, {level:?}");
        }
    }
}

#[test]
fn a_bent_sheet_has_neither_holes_nor_overlaps() {
    let (points, triangles) = sheet(23, 4);
    let raster = Rasterize { images: 1, vertices: points.len(), size: [200, 200] };
    let positions = project(&points);
    let mut times = vec![0; 40_000];
    for half in 0..triangles.len() {
        let mut out = Raster::default();
        cpu::forward(&raster, &positions, &triangles[half..half + 1], false, &mut out);
        times.iter_mut().zip(&out.ids).for_each(|(n, id)| *n += (*id != 0) as u32);
    }
    let inner = |p: usize| (50..150).contains(&(p % 200)) && (50..150).contains(&(p / 200));
    assert!((0..40_000).filter(|p| inner(*p)).all(|p| times[p] == 1));
    assert!(times.iter().all(|n| *n <= 1));
}

#[test]
fn corners_on_centers_leave_no_pixel_open() {
    // A sheet whose corners project onto centers of pixels only after rounding, as perspective does.
    let n = 16usize;
    let vertex = |i: usize| {
        let [x, y] = [i % (n + 1), i / (n + 1)].map(|v| (8.0 * v as f32 + 0.5) / 64.0 - 1.0);
        let w = 1.0 + random(1, i as u64)[0].abs();
        [x * w, y * w, 0.3 * w, w]
    };
    let positions: Vec<f32> = (0..(n + 1) * (n + 1)).flat_map(vertex).collect();
    let (_, triangles) = sheet(n, 1);
    let raster = Rasterize { images: 1, vertices: positions.len() / 4, size: [128, 128] };
    let want = reference::forward(&raster, &wide(&positions), &triangles, None).ids;
    for level in Level::available() {
        let mut out = Raster::default();
        with_level(level, || cpu::forward(&raster, &positions, &triangles, false, &mut out));
        assert!(out.ids.iter().all(|id| *id != 0), "{level:?}");
        assert_eq!(out.ids, want, "{level:?}");
    }
}

#[test]
fn layers_come_off_in_order_of_depth() {
    let c = cases().into_iter().find(|c| c.name == "odd size").unwrap();
    let (mut front, mut exact) = (forward(&c, true), reference::forward(&c.raster, &wide(&c.positions), &c.triangles, None));
    let (mut differ, mut covered) = (0, 0);
    for _ in 0..5 {
        let mut next = Raster::default();
        cpu::peel(&c.raster, &c.positions, &c.triangles, &front, true, &mut next);
        exact = reference::forward(&c.raster, &wide(&c.positions), &c.triangles, Some(&exact));
        differ += compare(&c, &next, &exact);
        covered += next.ids.iter().filter(|id| **id != 0).count();
        for p in 0..next.ids.len() {
            let behind = next.depth[p] > front.depth[p] || next.depth[p] == front.depth[p] && next.ids[p] > front.ids[p];
            assert!(next.ids[p] == 0 || front.ids[p] != 0 && behind, "pixel {p}");
        }
        front = next;
    }
    assert!(covered > 3000 && differ <= covered / 1000, "{differ} of {covered}");
    // Copies of one triangle are layers, too.
    let copies = Case { triangles: vec![[0, 1, 2]; 3], ..cases().into_iter().find(|c| c.name == "one triangle").unwrap() };
    let (mut layer, mut next) = (forward(&copies, false), Raster::default());
    for id in 1..4 {
        assert!(layer.ids.contains(&id) && layer.ids.iter().all(|i| [0, id].contains(i)));
        cpu::peel(&copies.raster, &copies.positions, &copies.triangles, &layer, false, &mut next);
        std::mem::swap(&mut layer, &mut next);
    }
    assert!(layer.ids.iter().all(|i| *i == 0));
}

#[test]
fn reference_gradients_match_central_differences() {
    for (points, triangles) in [soup(6, 1.0, 1.5, 31), (vec![[-0.7, -0.5, -0.5], [0.8, -0.3, 1.0], [-0.4, 0.5, 0.8]], vec![[0, 1, 2]])] {
        let r = Rasterize { images: 1, vertices: points.len(), size: [7, 9] };
        let positions = wide(&project(&points));
        let ids = reference::forward(&r, &positions, &triangles, None).ids;
        let covered = ids.iter().filter(|id| **id != 0).count();
        assert!(covered > 10, "{covered}");
        let n = r.pixels();
        let (uv, depth, derivatives) = (wide(&random(2 * n, 1)), wide(&random(n, 2)), wide(&random(4 * n, 3)));
        let loss = |positions: &[f64]| {
            let out = reference::shade(&r, positions, &triangles, ids.clone());
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            dot(&out.uv, &uv) + dot(&out.depth, &depth) + dot(&out.derivatives, &derivatives)
        };
        let up = reference::Upstream { uv: &uv, depth: &depth, derivatives: &derivatives };
        let gradient = reference::backward(&r, &positions, &triangles, &ids, &up);
        assert_gradient("positions", &gradient, &positions, 1e-4, loss);
    }
}

#[test]
fn screen_derivatives_are_differences_between_pixels() {
    let c = cases().into_iter().find(|c| c.name == "one triangle").unwrap();
    // A shift of the picture by a small part of a pixel is a shift of the positions.
    let shifted = |x: f64, y: f64| {
        let mut positions = reference::snapped(&c.raster, &wide(&c.positions));
        for p in positions.as_chunks_mut::<4>().0 {
            p[0] -= x / 32.0 * p[3];
            p[1] -= y / 32.0 * p[3];
        }
        reference::shade(&c.raster, &positions, &c.triangles, forward(&c, false).ids).uv
    };
    let h = 1e-4;
    let (right, left, down, up) = (shifted(h, 0.0), shifted(-h, 0.0), shifted(0.0, h), shifted(0.0, -h));
    let slope = |a: &[f64], b: &[f64], i: usize| (a[i] - b[i]) / (2.0 * h);
    let want: Vec<f64> = (0..2 * c.raster.pixels()).flat_map(|i| [slope(&right, &left, i), slope(&down, &up, i)]).collect();
    assert_close("derivatives", &forward(&c, true).derivatives, &want, 1e-4);
}

#[test]
fn gradients_match_the_reference_at_every_level() {
    for level in Level::available() {
        for c in cases() {
            let (raster, n) = (forward(&c, false), c.raster.pixels());
            let (uv, depth, derivatives) = (random(2 * n, 1), random(n, 2), random(4 * n, 3));
            let (zeros, mut got) = (vec![0.0; 4 * n], vec![9.0; c.positions.len()]);
            let (wide_uv, wide_depth, wide_derivatives) = (wide(&uv), wide(&depth), wide(&derivatives));
            let all = Upstream { uv: Some(&uv), depth: Some(&depth), derivatives: Some(&derivatives) };
            let wide_all = reference::Upstream { uv: &wide_uv, depth: &wide_depth, derivatives: &wide_derivatives };
            let only = Upstream { uv: Some(&uv), ..Default::default() };
            let wide_only = reference::Upstream { depth: &zeros[..n], derivatives: &zeros, ..wide_all };
            for (up, wide_up) in [(all, wide_all), (only, wide_only)] {
                with_level(level, || backward(&c.raster, &c.positions, &c.triangles, &raster, &up, &mut got));
                let positions = reference::snapped(&c.raster, &wide(&c.positions));
                let want = reference::backward(&c.raster, &positions, &c.triangles, &raster.ids, &wide_up);
                assert_close(c.name, &got, &want, 1e-3);
            }
        }
    }
}

#[test]
fn results_do_not_depend_on_threads() {
    let (points, triangles) = soup(3000, 0.2, 1.5, 41);
    let c = Case {
        name: "threads",
        raster: Rasterize { images: 1, vertices: points.len(), size: [300, 300] },
        positions: project(&points),
        triangles,
    };
    let uv = random(2 * c.raster.pixels(), 1);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let (raster, mut d) = (forward(&c, true), vec![0.0; c.positions.len()]);
            backward(&c.raster, &c.positions, &c.triangles, &raster, &Upstream { uv: Some(&uv), ..Default::default() }, &mut d);
            (raster, d)
        })
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn corners_that_are_no_numbers_cover_nothing() {
    let r = Rasterize { images: 1, vertices: 5, size: [20, 20] };
    let mut positions = project(&[[-0.7, -0.5, 1.0], [0.8, -0.3, 1.0], [0.1, 0.9, 1.0], [f32::NAN, 0.0, 1.0], [f32::INFINITY, 0.0, 1.0]]);
    positions[3] = 1.0;
    let mut out = Raster::default();
    cpu::forward(&r, &positions, &[[0, 1, 3], [0, 1, 4], [0, 1, 1], [0, 0, 0], [0, 1, 2]], true, &mut out);
    assert!(out.ids.contains(&5) && out.ids.iter().all(|id| [0, 5].contains(id)));
    assert!(out.uv.iter().chain(&out.derivatives).all(|v| v.is_finite()));
}

#[test]
#[should_panic(expected = "rasterize: vertex")]
fn vertices_that_are_not_there_are_refused() {
    let r = Rasterize { images: 1, vertices: 1, size: [2, 2] };
    cpu::forward(&r, &[0.0; 4], &[[0, 0, 1]], false, &mut Raster::default());
}
