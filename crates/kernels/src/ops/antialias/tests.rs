use super::*;
use crate::ops::rasterize::{self, Raster, Rasterize};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

struct Case {
    name: &'static str,
    antialias: Antialias,
    positions: Vec<f32>,
    triangles: Vec<[u32; 3]>,
}

/// Clip space of points before a camera: x right, y down, z forward, 90° wide, planes at 0.1 and 10.
fn project(points: &[[f32; 3]]) -> Vec<f32> {
    points.iter().flat_map(|p| [p[0], p[1], (p[2] * 10.1 - 2.0) / 9.9, p[2]]).collect()
}

fn soup(n: usize, size: f32, forward: f32, seed: u64) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let (centers, edges) = (random(3 * n, seed), random(9 * n, seed + 1));
    let at = |i: usize| std::array::from_fn(|k| centers[i / 3 * 3 + k] + size * edges[3 * i + k] + if k == 2 { forward } else { 0.0 });
    ((0..3 * n).map(at).collect(), (0..n as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect())
}

/// A closed torus before the camera, of `2 n²` triangles.
fn torus(n: u32) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let at = |i: u32| {
        let turn = |k: u32| (k as f32 + 0.3) * std::f32::consts::TAU / n as f32;
        let (a, b) = (turn(i / n), turn(i % n));
        let ring = 0.7 + 0.3 * b.cos();
        let (x, y, z) = (ring * a.cos(), ring * a.sin(), 0.3 * b.sin());
        [x, 0.6 * y - 0.8 * z, 0.8 * y + 0.6 * z + 1.5]
    };
    let corner = |i: u32, j: u32| i % n * n + j % n;
    let square = |s: u32| {
        let (i, j) = (s / n, s % n);
        let [a, b, c, d] = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
        [[a, b, c], [a, c, d]]
    };
    ((0..n * n).map(at).collect(), (0..n * n).flat_map(square).collect())
}

fn case(name: &'static str, size: [usize; 2], channels: usize, (points, triangles): (Vec<[f32; 3]>, Vec<[u32; 3]>)) -> Case {
    Case {
        name,
        antialias: Antialias { images: 1, vertices: points.len(), size, channels, follow: 0 },
        positions: project(&points),
        triangles,
    }
}

fn following(c: Case, follow: usize) -> Case {
    Case { antialias: Antialias { follow, ..c.antialias }, ..c }
}

fn cases() -> Vec<Case> {
    let one = |z: [f32; 3]| (vec![[-0.7, -0.5, z[0]], [0.8, -0.3, z[1]], [0.1, 0.9, z[2]]], vec![[0, 1, 2]]);
    let mut two = case("two images", [21, 17], 2, soup(30, 0.5, 1.5, 11));
    two.positions.extend(project(&soup(30, 0.5, 1.7, 13).0));
    two.antialias.images = 2;
    vec![
        case("empty", [9, 9], 3, (vec![], vec![])),
        case("no pixels", [0, 7], 3, one([1.0; 3])),
        case("one pixel", [1, 1], 3, one([1.0; 3])),
        case("one triangle", [40, 33], 3, one([1.0, 1.2, 0.9])),
        case("across the near plane", [40, 33], 1, one([0.8, 1.0, -0.4])),
        case("soup", [48, 64], 3, soup(60, 0.4, 1.5, 5)),
        case("around the camera", [48, 48], 3, soup(100, 0.5, 0.0, 7)),
        case("torus", [60, 60], 4, torus(20)),
        following(case("torus, followed", [60, 60], 1, torus(30)), 4),
        // The third triangle of an edge makes it an edge of three.
        case("fan", [50, 50], 2, (soup(5, 0.9, 1.5, 3).0, vec![[0, 1, 2], [1, 0, 3], [0, 1, 5], [5, 6, 7], [6, 5, 9], [10, 12, 11]])),
        two,
    ]
}

impl Case {
    fn raster(&self) -> Raster {
        let (a, mut out) = (&self.antialias, Raster::default());
        let r = Rasterize { images: a.images, vertices: a.vertices, size: a.size };
        rasterize::cpu::forward(&r, &self.positions, &self.triangles, false, &mut out);
        out
    }

    fn find(&self, raster: &Raster) -> Vec<Crossing> {
        let visible = Visible { ids: &raster.ids, depth: &raster.depth };
        cpu::find(&self.antialias, &self.positions, &self.triangles, &Topology::new(&self.triangles), visible)
    }

    fn colors(&self) -> Vec<f32> {
        random(self.antialias.images * self.antialias.size[0] * self.antialias.size[1] * self.antialias.channels, 3)
    }
}

#[test]
fn matches_the_reference_both_ways() {
    let mut blended = 0;
    for c in cases() {
        let (a, raster, colors) = (&c.antialias, c.raster(), c.colors());
        let (crossings, d) = (c.find(&raster), random(colors.len(), 4));
        let (mut out, mut d_colors, mut d_positions) = (vec![9.0; d.len()], vec![9.0; d.len()], vec![9.0; c.positions.len()]);
        cpu::forward(a, &crossings, &colors, &mut out);
        cpu::backward(a, &c.positions, &crossings, &colors, &d, &mut d_colors, &mut d_positions);
        let depth = wide(&raster.depth);
        let visible = reference::Visible { ids: &raster.ids, depth: &depth };
        let (positions, colors) = (wide(&c.positions), wide(&colors));
        assert_close(c.name, &out, &reference::forward(a, &positions, &c.triangles, &visible, &colors), 1e-5);
        let (want_colors, want_positions) = reference::backward(a, &positions, &c.triangles, &visible, &colors, &wide(&d));
        assert_close(c.name, &d_colors, &want_colors, 1e-5);
        assert_close(c.name, &d_positions, &want_positions, 1e-4);
        blended += crossings.len();
    }
    assert!(blended > 1000, "{blended}");
}

#[test]
fn reference_gradients_match_central_differences() {
    for c in [
        case("soup", [9, 8], 2, soup(6, 0.8, 1.5, 5)),
        case("torus", [12, 12], 1, torus(5)),
        following(case("torus, followed", [12, 12], 1, torus(12)), 3),
        case("across the near plane", [9, 9], 1, (vec![[-0.7, -0.5, 0.8], [0.8, -0.3, 1.0], [0.1, 0.4, -0.4]], vec![[0, 1, 2]])),
    ] {
        let (a, raster, colors) = (&c.antialias, c.raster(), wide(&c.colors()));
        assert!(c.find(&raster).len() > 5, "{}", c.name);
        let (positions, depth, d) = (wide(&c.positions), wide(&raster.depth), wide(&random(colors.len(), 4)));
        let visible = reference::Visible { ids: &raster.ids, depth: &depth };
        let loss = |positions: &[f64], colors: &[f64]| {
            reference::forward(a, positions, &c.triangles, &visible, colors).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>()
        };
        let (d_colors, d_positions) = reference::backward(a, &positions, &c.triangles, &visible, &colors, &d);
        assert_gradient(c.name, &d_colors, &colors, 1e-6, |colors| loss(&positions, colors));
        assert_gradient(c.name, &d_positions, &positions, 1e-4, |positions| loss(positions, &colors));
    }
}

/// Coverage by a triangle of a picture of 40² pixels, with and without antialiasing, and exactly.
fn coverage(points: &[[f32; 3]; 3]) -> [Vec<f32>; 3] {
    let c = case("coverage", [40, 40], 1, (points.to_vec(), vec![[0, 1, 2]]));
    let fine =
        Case { antialias: Antialias { size: [1280, 1280], ..c.antialias }, ..case("", [1, 1], 1, (points.to_vec(), vec![[0, 1, 2]])) };
    let (raster, fine) = (c.raster(), fine.raster());
    let hard: Vec<f32> = raster.ids.iter().map(|id| (*id != 0) as u32 as f32).collect();
    let mut exact = vec![0.0; 1600];
    fine.ids.iter().enumerate().filter(|(_, id)| **id != 0).for_each(|(p, _)| exact[p / 1280 / 32 * 40 + p % 1280 / 32] += 1.0 / 1024.0);
    let mut soft = vec![0.0; 1600];
    cpu::forward(&c.antialias, &c.find(&raster), &hard, &mut soft);
    [soft, hard, exact]
}

#[test]
fn blended_edges_come_close_to_exact_coverage() {
    let (mut soft_error, mut hard_error) = (0.0, 0.0);
    for i in 0..24 {
        let turn = |k: usize| (i as f32 * 0.61 + k as f32 * 2.1).sin_cos();
        let points = std::array::from_fn(|k| [0.8 * turn(k).0, 0.8 * turn(k).1, 1.0]);
        let [soft, hard, exact] = coverage(&points);
        let error = |a: &[f32]| a.iter().zip(&exact).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
        soft_error += error(&soft);
        hard_error += error(&hard);
    }
    println!("squared error {soft_error} instead of {hard_error}");
    assert!(soft_error < 0.05 * hard_error, "{soft_error} {hard_error}");
}

#[test]
fn gradients_of_coverage_are_those_of_the_area() {
    let (mut got, mut want) = (0.0, 0.0);
    for i in 0..24 {
        let turn = |k: usize| (i as f32 * 0.61 + k as f32 * 2.1).sin_cos();
        let points: Vec<[f32; 3]> = (0..3).map(|k| [0.8 * turn(k).0, 0.8 * turn(k).1, 1.0]).collect();
        let c = case("area", [40, 40], 1, (points, vec![[0, 1, 2]]));
        let raster = c.raster();
        let colors: Vec<f32> = raster.ids.iter().map(|id| (*id != 0) as u32 as f32).collect();
        let (mut d_colors, mut d_positions) = (vec![0.0; 1600], vec![0.0; 12]);
        cpu::backward(&c.antialias, &c.positions, &c.find(&raster), &colors, &[1.0; 1600], &mut d_colors, &mut d_positions);
        // The area grows with the square of the triangle's size.
        got += (0..12).map(|k| if k % 4 < 2 { d_positions[k] * c.positions[k] } else { 0.0 }).sum::<f32>();
        let corner = |k: usize| [20.0 * c.positions[4 * k], 20.0 * c.positions[4 * k + 1]];
        let [a, b, d] = [corner(0), corner(1), corner(2)];
        want += ((b[0] - a[0]) * (d[1] - a[1]) - (b[1] - a[1]) * (d[0] - a[0])).abs();
    }
    assert!((got - want).abs() < 0.03 * want, "{got} {want}");
}

#[test]
fn silhouettes_of_fine_meshes_are_found_by_following_the_surface() {
    // Growth of the picture of a closed surface by its scale, as a share of twice its area.
    let growth = |follow: usize| {
        let c = following(case("torus", [150, 150], 1, torus(60)), follow);
        let raster = c.raster();
        let colors: Vec<f32> = raster.ids.iter().map(|id| (*id != 0) as u32 as f32).collect();
        let (mut d_colors, mut d_positions) = (vec![0.0; colors.len()], vec![0.0; c.positions.len()]);
        let ones = vec![1.0; colors.len()];
        cpu::backward(&c.antialias, &c.positions, &c.find(&raster), &colors, &ones, &mut d_colors, &mut d_positions);
        let got: f32 = (0..c.positions.len()).filter(|k| k % 4 < 2).map(|k| d_positions[k] * c.positions[k]).sum();
        got / (2.0 * colors.iter().sum::<f32>())
    };
    let (plain, followed) = (growth(0), growth(8));
    println!("{plain} of the growth, {followed} when followed");
    assert!(plain < 0.5 && (followed - 1.0).abs() < 0.05, "{plain} {followed}");
}

#[test]
fn only_silhouettes_are_blended() {
    let c = following(case("torus", [120, 120], 1, torus(40)), 8);
    let raster = c.raster();
    let colors = c.colors();
    let mut out = vec![0.0; colors.len()];
    let crossings = c.find(&raster);
    cpu::forward(&c.antialias, &crossings, &colors, &mut out);
    // Every pixel that changed has a neighbor of another layer: the background, or a part of the torus well behind or before it.
    let (mut changed, mut within) = (0, 0);
    for p in (0..colors.len()).filter(|p| out[*p] != colors[*p]) {
        let (x, y) = (p % 120, p / 120);
        let neighbors = [(x > 0, p.wrapping_sub(1)), (x < 119, p + 1), (y > 0, p.wrapping_sub(120)), (y < 119, p + 120)];
        let is_layer = |q: usize| (raster.ids[q] == 0) != (raster.ids[p] == 0) || (raster.depth[q] - raster.depth[p]).abs() > 0.003;
        changed += 1;
        within += !neighbors.into_iter().any(|(inside, q)| inside && is_layer(q)) as usize;
    }
    assert!(changed > 200 && within <= changed / 50, "{within} of {changed}");
    // Of a closed surface, most edges are none.
    let mismatched = (0..raster.ids.len() - 1).filter(|p| p % 120 < 119 && raster.ids[*p] != raster.ids[p + 1]).count();
    assert!(crossings.len() * 2 < mismatched, "{} {mismatched}", crossings.len());
}

#[test]
fn neighbors_are_found_whatever_the_winding() {
    let t = Topology::new(&[[0, 1, 2], [2, 1, 3], [1, 2, 4], [3, 5, 1]]);
    // The edge 1–2 has three triangles, 1–3 has two.
    assert_eq!((t.across(0, 0), t.across(0, 1), t.across(1, 0)), (None, None, Some((3, 1))));
    assert_eq!((t.across(3, 1), t.across(3, 0), t.len()), (Some((1, 0)), None, 4));
    assert!(Topology::new(&[]).is_empty());
}

#[test]
fn crossings_do_not_depend_on_threads() {
    let c = case("soup", [200, 200], 1, soup(500, 0.3, 1.5, 5));
    let raster = c.raster();
    let with = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| c.find(&raster));
    assert_eq!(with(1), with(3));
}
