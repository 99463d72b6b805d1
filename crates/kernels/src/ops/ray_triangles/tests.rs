use super::*;
use crate::simd::{Level, with_level};
use cases::{rays, soup, sphere, through_edges};

fn nearest(bvh: &Bvh, rays: &[Ray]) -> Vec<Hit> {
    let mut hits = vec![Hit::NONE; rays.len()];
    cpu::nearest(bvh, rays, &mut hits);
    hits
}

#[test]
fn bundles_have_the_hits_of_each_ray_on_every_level() {
    // Some bundles are alike, others point to all sides, and the last rays fill none.
    let (vertices, triangles) = soup(2000, 0.2, 5);
    let bvh = Bvh::build(&vertices, &triangles);
    let mut rays = rays(803, 21);
    for i in 0..400 {
        let (first, [a, b, c]) = (rays[i / 8 * 8], rays[i].direction.map(|d| 0.02 * d));
        rays[i] = Ray { direction: [first.direction[0] + a, first.direction[1] + b, first.direction[2] + c], range: [0.1, 2.0], ..first };
    }
    for empty in [false, true] {
        let bvh = if empty { Bvh::build(&[], &[]) } else { bvh.clone() };
        let want = nearest(&bvh, &rays);
        assert_eq!(want.iter().any(Hit::is_some), !empty);
        for level in Level::available() {
            let mut hits = vec![Hit::NONE; rays.len()];
            with_level(level, || bvh.trace_neighbors(&rays, &mut hits));
            assert_eq!(hits, want, "{}", level.name());
        }
    }
}

#[test]
fn nearest_hits_match_the_reference_on_every_level() {
    for (n, size) in [(0, 0.1), (1, 1.0), (9, 0.5), (700, 0.3), (3000, 0.1)] {
        let (vertices, triangles) = soup(n, size, 3);
        let (bvh, rays) = (Bvh::build(&vertices, &triangles), rays(1500, 9));
        let want: Vec<_> = rays.iter().map(|r| reference::nearest(&vertices, &triangles, r)).collect();
        for level in Level::available() {
            let hits = with_level(level, || nearest(&bvh, &rays));
            let mut others = 0;
            for (hit, want) in hits.iter().zip(&want) {
                match want {
                    Some((t, triangle, [u, v])) if *triangle == hit.triangle => {
                        assert!((t - hit.t as f64).abs() < 1e-4 * t.max(1.0), "{hit:?} {want:?}");
                        assert!((u - hit.weights[0] as f64).abs() < 1e-2 && (v - hit.weights[1] as f64).abs() < 1e-2, "{hit:?} {want:?}");
                    }
                    None if !hit.is_some() => {}
                    _ => others += 1,
                }
            }
            assert!(others <= rays.len() / 1000, "{others} of {} rays differ among {n} triangles", rays.len());
        }
        assert!(n < 700 || want.iter().filter(|w| w.is_some()).count() > 100, "the rays must meet triangles");
    }
}

#[test]
fn no_ray_passes_between_the_triangles_of_a_closed_surface() {
    let mesh = sphere(24);
    let (bvh, through) = (Bvh::build(&mesh.0, &mesh.1), through_edges(&mesh));
    for level in Level::available() {
        let hits = with_level(level, || nearest(&bvh, &through));
        let missed = hits.iter().filter(|h| !h.is_some()).count();
        assert_eq!(missed, 0, "of {} rays, {level:?}", hits.len());
    }
}

#[test]
fn any_hit_exists_exactly_where_the_nearest_does_within_the_range() {
    let (vertices, triangles) = soup(2000, 0.05, 21);
    let bvh = Bvh::build(&vertices, &triangles);
    let mut rays = rays(2000, 33);
    let full = nearest(&bvh, &rays);
    for (ray, hit) in rays.iter_mut().zip(&full).filter(|(_, h)| h.is_some()) {
        // Half of the ranges end before the hit, or begin after it.
        ray.range = if hit.triangle % 4 == 0 { [0.0, 0.999 * hit.t] } else { [0.0, 1.001 * hit.t] };
    }
    let mut hits = vec![Hit::NONE; rays.len()];
    cpu::any(&bvh, &rays, &mut hits);
    let near = nearest(&bvh, &rays);
    for (i, (any, full)) in hits.iter().zip(&full).enumerate() {
        assert_eq!(any.is_some(), full.is_some() && full.triangle % 4 != 0, "ray {i}");
        assert_eq!(any.is_some(), near[i].is_some(), "ray {i}");
        assert!(!any.is_some() || any.t > rays[i].range[0] && any.t < rays[i].range[1]);
    }
    for (ray, hit) in rays.iter_mut().zip(&full).filter(|(_, h)| h.is_some()) {
        ray.range = [hit.t, f32::INFINITY];
    }
    assert!(nearest(&bvh, &rays).iter().zip(&full).all(|(next, h)| !h.is_some() || next.t > h.t), "ranges are open");
}

#[test]
fn odd_meshes_build() {
    let one = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let down = Ray { origin: [0.2, 0.2, 1.0], direction: [0.0, 0.0, -2.0], range: [0.0, 9.0] };
    // Many copies of one triangle cannot be told apart; the first is hit.
    let copies = Bvh::build(&one, &vec![[0, 1, 2]; 5000]);
    let hit = nearest(&copies, &[down])[0];
    assert_eq!((hit.triangle, hit.t), (0, 0.5));
    // Triangles without area, and with corners that are no numbers, are never hit.
    let mut vertices = one.to_vec();
    vertices.push([f32::NAN, 0.0, 0.0]);
    let flat = Bvh::build(&vertices, &[[0, 1, 1], [0, 0, 0], [0, 1, 3], [0, 1, 2]]);
    assert_eq!(nearest(&flat, &[down])[0].triangle, 3);
    assert!(!nearest(&Bvh::build(&[], &[]), &[down])[0].is_some());
}

#[test]
fn the_tree_and_its_hits_do_not_depend_on_threads() {
    let (vertices, triangles) = soup(40_000, 0.02, 5);
    let rays = rays(3000, 6);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| nearest(&Bvh::build(&vertices, &triangles), &rays))
    };
    assert_eq!(with(1), with(3));
}
