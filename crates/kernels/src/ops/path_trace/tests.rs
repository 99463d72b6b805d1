use super::cases::*;
use super::*;
use crate::simd::{Level, with_level};
use diorama_geom::daylight::Sun;
use diorama_geom::environment::Environment;
use diorama_geom::glam::{DAffine3, DQuat};
use diorama_geom::model::{Instance, Material, Opacity, Texture, Wrap};
use diorama_geom::{ImageU8, Mesh};

fn render(scene: &Scene, view: &View, settings: &Settings, samples: u32) -> Film {
    let mut film = Film::new(&view.camera);
    cpu::render(scene, view, settings, samples, &mut film);
    film
}

fn furnace() -> Daylight {
    Daylight::of(Environment::uniform([1.0; 3], 8))
}

#[test]
fn a_white_ball_in_a_white_furnace_is_invisible() {
    let eye = DVec3::new(0.0, -4.5, 0.0);
    for (roughness, metallic, bound) in [(1.0, 0.0, 0.005), (0.5, 0.0, 0.02), (0.3, 1.0, 0.02), (1.0, 1.0, 0.02)] {
        let scene = Scene::new(&model(vec![(sphere(64), glossy([1.0; 3], roughness, metallic))]), &furnace());
        let film = render(&scene, &view(24, eye, DVec3::ZERO, DVec3::Z), &Settings::default(), 256);
        for p in &film.pixels {
            // At the silhouette, the flat triangles of the mesh cut off a part of the hemisphere of the normal.
            let facing = -(p.normal[1]);
            if p.opacity == 0.0 || (p.opacity == 1.0 && facing > 0.3) {
                assert!((p.color[1] - 1.0).abs() < 3.0 * bound, "roughness {roughness}, metallic {metallic}: {p:?}");
            }
        }
        let inner: Vec<f32> = film.pixels.iter().filter(|p| p.opacity == 1.0 && -p.normal[1] > 0.3).map(|p| p.color[1]).collect();
        let mean = inner.iter().sum::<f32>() / inner.len() as f32;
        assert!(inner.len() > 150 && (mean - 1.0).abs() < bound, "roughness {roughness}, metallic {metallic}: {mean}");
    }
}

/// Mean color of a picture, and the standard error of that mean estimated from pictures of other seeds.
fn mean_and_error(scene: &Scene, view: &View, settings: &Settings, samples: u32) -> ([f64; 3], [f64; 3]) {
    let means: Vec<[f64; 3]> = (0..8)
        .map(|seed| {
            let film = render(scene, view, &Settings { seed, ..*settings }, samples);
            std::array::from_fn(|k| film.pixels.iter().map(|p| p.color[k] as f64).sum::<f64>() / film.pixels.len() as f64)
        })
        .collect();
    let n = means.len() as f64;
    let mean: [f64; 3] = std::array::from_fn(|k| means.iter().map(|m| m[k]).sum::<f64>() / n);
    let spread = |k: usize| means.iter().map(|m| (m[k] - mean[k]).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, std::array::from_fn(|k| (spread(k) / n).sqrt()))
}

#[test]
fn light_surface_and_both_strategies_have_the_same_mean() {
    let (scene, view) = (Scene::new(&balls(), &day()), balls_view(16));
    let of = |strategy: Strategy, samples: u32| {
        mean_and_error(&scene, &view, &Settings { strategy, shows_light: false, bounces: 4, ..Settings::default() }, samples)
    };
    let (both, light, surface) = (of(Strategy::Both, 64), of(Strategy::Light, 64), of(Strategy::Surface, 512));
    for other in [light, surface] {
        for k in 0..3 {
            let error = (both.1[k].powi(2) + other.1[k].powi(2)).sqrt();
            assert!((both.0[k] - other.0[k]).abs() < 3.0 * error + 1e-4, "{both:?} {other:?}");
            // The comparison means something only where the error is small.
            assert!(error < 0.03 * both.0[k], "{error} {both:?}");
        }
    }
}

#[test]
fn pixels_agree_with_the_reference() {
    let (model, mut light, view) = (balls(), day(), balls_view(6));
    // Large, so that uniform directions meet it often enough.
    light.sun.as_mut().unwrap().diameter = 0.6;
    let scene = Scene::new(&model, &light);
    let settings = Settings { bounces: 3, ..Settings::default() };
    let film = render(&scene, &view, &settings, 4096);
    for [x, y] in [[1, 3], [2, 2], [3, 4], [4, 3]] {
        let (want, error) = reference::pixel(&model, &light, &view, [x, y], 3, 20_000);
        let got = film.pixels[y * 6 + x].color;
        for k in 0..3 {
            let bound = 3.5 * error[k] + 5e-3 * want[k];
            assert!((got[k] as f64 - want[k]).abs() < bound, "pixel {x} {y}: {got:?}, reference {want:?} ± {error:?}");
        }
    }
}

#[test]
fn copies_of_a_part_look_like_parts_of_their_own() {
    let moved = |angle: f64, x: f64| {
        DAffine3::from_scale_rotation_translation(DVec3::new(0.7, 0.5, 0.9), DQuat::from_rotation_y(angle), DVec3::new(x, 0.0, 1.0))
    };
    let placed = [moved(0.4, -1.2), moved(2.0, 0.0), moved(-0.7, 1.3)];
    let mut copies = model(vec![(square(4.0, 0.0), matte([0.5; 3])), (sphere(12), matte([0.8, 0.4, 0.2]))]);
    let mut parts = copies.clone();
    copies.instances.truncate(1);
    parts.instances.truncate(1);
    parts.parts.truncate(1);
    for world_from_part in placed {
        copies.instances.push(Instance { part: 1, world_from_part });
        parts.parts.push(copies.parts[1].clone());
        parts.instances.push(Instance { part: parts.parts.len() - 1, world_from_part });
    }
    let view = balls_view(32);
    let settings = Settings { bounces: 2, light_layers: true, ..Settings::default() };
    let [a, b] = [copies, parts].map(|m| {
        // No copy is stored one by one.
        let scene = Scene { geometry: Geometry::with_copies(&m, 0), ..Scene::new(&m, &day()) };
        (render(&scene, &view, &settings, 16), cpu::first_hits(&scene, &view, true))
    });
    let difference = |f: &dyn Fn(&Pixel) -> f32| {
        let sum: f32 = a.0.pixels.iter().zip(&b.0.pixels).map(|(p, q)| (f(p) - f(q)).abs()).sum();
        sum / a.0.pixels.len() as f32
    };
    assert!(difference(&|p| p.normal[0]) < 2e-3 && difference(&|p| p.depth) < 1e-2 && difference(&|p| p.color[0]) < 1e-2);
    let same = a.1.iter().zip(&b.1).filter(|(p, q)| p.map(|h| h.instance) == q.map(|h| h.instance)).count();
    assert!(same >= a.1.len() - 4, "{same}");
    assert!((1..4).all(|i| a.1.iter().flatten().any(|h| h.instance == i)));
}

#[test]
fn a_picture_continues_where_it_stopped_whatever_the_threads_and_instructions() {
    let (scene, view) = (Scene::new(&balls(), &day()), balls_view(16));
    let settings = Settings { light_layers: true, ..Settings::default() };
    let mut film = render(&scene, &view, &settings, 8);
    let mut resumed = Film::of_image(&film.to_image(), film.samples);
    cpu::render(&scene, &view, &settings, 8, &mut film);
    cpu::render(&scene, &view, &settings, 8, &mut resumed);
    assert_eq!(film, resumed);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let once = |level: Level| with_level(level, || render(&scene, &view, &settings, 8));
    let alone = pool.install(|| once(Level::Portable));
    for level in Level::available() {
        assert_eq!(once(level), alone, "{}", level.name());
    }
}

#[test]
fn panes_reflect_pass_and_tint() {
    let pane = Material { roughness: 0.1, transmission: 1.0, ..matte([1.0; 3]) };
    let above = view(8, DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO, DVec3::Y);
    let mean = |scene: &Scene, samples: u32| {
        let film = render(scene, &above, &Settings::default(), samples);
        film.pixels.iter().map(|p| p.color[1] as f64).sum::<f64>() / film.pixels.len() as f64
    };
    // In a furnace, what is not passed is reflected.
    let white = mean(&Scene::new(&model(vec![(square(2.0, 0.0), pane.clone())]), &furnace()), 256);
    assert!((white - 1.0).abs() < 0.02, "{white}");
    // Light from below alone: through a green pane, at a right angle.
    let below = Daylight::of(Environment::from_fn(32, |d| if d.z < 0.0 { [1.0; 3] } else { [0.0; 3] }));
    let tinted =
        mean(&Scene::new(&model(vec![(square(2.0, 0.0), Material { base_color: [0.2, 0.5, 0.2, 1.0], ..pane.clone() })]), &below), 1024);
    assert!((tinted - 0.5 * 0.96).abs() < 0.015, "{tinted}");
    // A floor under a pane gets what the pane lets pass, twice.
    // The sun stands aside, so that its reflection misses the eye.
    let sun = Sun { direction: DVec3::new(0.5, 0.0, 0.75f64.sqrt()), diameter: 0.01, irradiance: [1.0; 3] };
    let dark = Daylight { environment: Environment::uniform([0.0; 3], 4), sun: Some(sun) };
    let floor = (square(3.0, 0.0), matte([0.5; 3]));
    let settings = Settings { bounces: 1, ..Settings::default() };
    let lit = |parts: Vec<(Mesh, Material)>| {
        let film = render(&Scene::new(&model(parts), &dark), &above, &settings, 512);
        film.pixels.iter().map(|p| p.color[1] as f64).sum::<f64>() / film.pixels.len() as f64
    };
    let (bare, covered) = (lit(vec![floor.clone()]), lit(vec![floor, (square(3.0, 1.0), pane)]));
    assert!((covered / bare - 0.96 * 0.96).abs() < 0.03, "{bare} {covered}");
}

#[test]
fn holes_let_the_eye_and_the_sun_through() {
    let image = ImageU8 { width: 2, height: 1, channels: 4, data: vec![255, 255, 255, 255, 255, 255, 255, 0] };
    let mut scene = model(vec![
        (square(1.0, 1.0), Material { base_color_texture: Some(0), opacity: Opacity::Cutoff(0.5), ..matte([1.0; 3]) }),
        (square(4.0, 0.0), matte([0.5; 3])),
    ]);
    scene.textures.push(Texture { image, wrap: [Wrap::Clamp; 2] });
    let sun = Sun { direction: DVec3::Z, diameter: 0.01, irradiance: [1.0; 3] };
    let light = Daylight { environment: Environment::uniform([0.0; 3], 4), sun: Some(sun) };
    // From the side, where the floor below the square is visible.
    let view = view(64, DVec3::new(0.0, -6.0, 0.7), DVec3::new(0.0, 0.0, 0.1), DVec3::Z);
    let scene = Scene::new(&scene, &light);
    let film = render(&scene, &view, &Settings { light_layers: true, ..Settings::default() }, 16);
    let hits = cpu::first_hits(&scene, &view, false);
    let mut seen = [0; 2];
    for (hit, pixel) in hits.iter().zip(&film.pixels) {
        if let Some(h) = hit.filter(|h| h.instance == 1 && h.position.x.abs() < 0.9 && h.position.y.abs() < 0.9 && h.position.x.abs() > 0.1)
        {
            let is_shaded = h.position.x < 0.0;
            seen[is_shaded as usize] += 1;
            assert!((pixel.sun < 0.2) == is_shaded && (pixel.sun > 0.8) != is_shaded, "{h:?} {pixel:?}");
            assert!(is_shaded || (pixel.unshadowed / pixel.direct - 1.0).abs() < 0.2, "{pixel:?}");
        }
    }
    assert!(seen[0] > 30 && seen[1] > 30, "{seen:?}");
}

#[test]
fn shadows_turn_with_the_light() {
    // A post on a floor; the shadow's direction is that of the darkest floor around it.
    let mut post = sphere(8);
    post.positions.iter_mut().for_each(|p| *p = [0.1 * p[0], 0.1 * p[1], 1.0 + p[2]]);
    let scene = model(vec![(square(6.0, 0.0), matte([0.5; 3])), (post, matte([0.5; 3]))]);
    let view = view(96, DVec3::new(0.0, 0.0, 14.0), DVec3::ZERO, DVec3::Y);
    let sun = Sun { direction: DVec3::new(0.7, 0.1, 0.7).normalize(), diameter: 0.01, irradiance: [3.0; 3] };
    let light = Daylight { environment: Environment::uniform([0.05; 3], 4), sun: Some(sun) };
    let azimuth = |light: Daylight| {
        let scene = Scene::new(&scene, &light);
        let film = render(&scene, &view, &Settings { light_layers: true, ..Settings::default() }, 32);
        let (mut x, mut y) = (0.0, 0.0);
        for (hit, pixel) in cpu::first_hits(&scene, &view, true).iter().zip(&film.pixels) {
            if let Some(h) = hit.filter(|h| h.instance == 0 && h.position.truncate().length() > 0.3) {
                let shadow = (1.0 - pixel.sun) as f64;
                (x, y) = (x + shadow * h.position.x, y + shadow * h.position.y);
            }
        }
        y.atan2(x)
    };
    let before = azimuth(light.clone());
    assert!((before - (-0.1f64).atan2(-0.7)).abs() < 2f64.to_radians(), "{before}");
    for turn in [0.5, -1.2] {
        let after = azimuth(light.clone().turned(turn, 1.0));
        let error = (after - before - turn + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
        assert!(error.abs() < 2f64.to_radians(), "turned by {turn}: {before} {after}");
    }
}

#[test]
fn a_thin_lens_is_sharp_at_its_focus() {
    // A small lamp at distance 4, seen by lenses focused on it and elsewhere.
    let lamp = Material { emission: [1.0; 3], ..matte([0.0; 3]) };
    let scene = Scene::new(&model(vec![(square(0.02, 0.0), lamp)]), &Daylight::of(Environment::uniform([0.0; 3], 4)));
    let spread = |focus: f64| {
        let mut view = view(33, DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO, DVec3::Y);
        view.lens = Some(ThinLens { radius: 0.2, focus });
        let film = render(&scene, &view, &Settings::default(), 256);
        let (mut sum, mut moment) = (0.0, 0.0);
        for (i, p) in film.pixels.iter().enumerate() {
            let (x, y) = ((i % 33) as f32 - 16.0, (i / 33) as f32 - 16.0);
            (sum, moment) = (sum + p.color[0], moment + p.color[0] * (x * x + y * y));
        }
        (moment / sum).sqrt()
    };
    assert!(spread(4.0) < 0.8, "{}", spread(4.0));
    // Radius of the circle of confusion in pixels, of whose square half is the mean: r |1/4 − 1/f| · focal length.
    let camera = Camera::pinhole(33, 33, 0.6);
    let want = 0.2 * (0.25f64 - 0.4).abs() * camera.fx / 2f64.sqrt();
    let got = spread(2.5) as f64;
    assert!((got / want - 1.0).abs() < 0.1, "{got} {want}");
}
