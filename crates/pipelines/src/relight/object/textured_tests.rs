use super::*;
use crate::relight::object::capture::ObjectPhoto;
use crate::relight::object::config::Preset;
use diorama_geom::Image;
use diorama_geom::camera::Camera;
use diorama_geom::capture::Split;
use diorama_geom::glam::DVec3;
use diorama_geom::transform::Pose;

/// Cells per side of a square sheet.
const CELLS: usize = 8;

/// A sheet with a smooth pattern, and how a bump in it moves its vertices.
fn sheet(config: &Config) -> (Textured, Vec<[f32; 3]>) {
    let side = CELLS + 1;
    let at = |i: usize| [(i % side) as f32 / CELLS as f32 - 0.5, (i / side) as f32 / CELLS as f32 - 0.5, 0.0];
    let corner = |i: usize| (i / CELLS * side + i % CELLS) as u32;
    let cell = |i: usize| {
        let (a, down) = (corner(i), side as u32);
        [[a, a + 1, a + down + 1], [a, a + down + 1, a + down]]
    };
    let mesh =
        Mesh { positions: (0..side * side).map(at).collect(), faces: (0..CELLS * CELLS).flat_map(cell).collect(), ..Mesh::default() };
    let mut model = Textured::new(config, &mesh, None);
    let size = config.material.texture;
    let texels = bake::texels(&model.mesh(), size);
    let pattern = |p: &[f32; 3]| [0, 1, 2].map(|k| 0.5 + 0.3 * (9.0 * p[0] + k as f32).sin() * (7.0 * p[1] - k as f32).cos());
    let colors: Vec<[f32; 3]> = texels.positions.iter().map(pattern).collect();
    for (t, c) in model.texels.values.as_chunks_mut::<CHANNELS>().0.iter_mut().zip(bake::spread(&texels, &colors, size)) {
        t[..3].copy_from_slice(&c);
    }
    let bump = |p: &[f32; 3]| [0.0, 0.0, ((0.25 - p[0] * p[0]) * (0.25 - p[1] * p[1])) / 0.0625];
    let bumps = model.places().iter().map(bump).collect();
    (model, bumps)
}

fn raised(model: &mut Textured, bumps: &[[f32; 3]], by: f32) {
    model.positions.values.iter_mut().zip(bumps.as_flattened()).for_each(|(p, b)| *p += by * b);
}

#[test]
fn a_surface_moves_to_where_its_texture_is_seen() {
    let mut config = Config::new(Preset::Ci, "none".into());
    (config.run.samples, config.loss.color_smoothness) = (2, 0.0);
    let (mut model, bumps) = sheet(&config);
    let mut probe = Probe::new(config.light.cube, Adam::default());
    probe.update();
    let pose = Pose::look_at(DVec3::new(1.0, 0.4, 0.9), DVec3::ZERO, DVec3::Z);
    let view = ObjectView::new(Camera::pinhole(96, 96, 0.7), pose);
    // The photograph shows the sheet with a bump, and is trained on without.
    raised(&mut model, &bumps, 0.05);
    let [seen, _] = model.picture(&view, &probe);
    raised(&mut model, &bumps, -0.05);
    let rgba = Image { width: 96, height: 96, channels: 4, data: seen };
    let photo = ObjectPhoto { name: "bump".into(), rgba, view, split: Split::Train };
    let mut loss_at = |model: &Textured| {
        let drawn = model.drawn();
        let looked = model.look(&photo.view.finer(config.run.samples), &drawn);
        let pass = ViewPass { config: &config, photo: &photo, share: 1.0, rng: Rng::new(5, 0), progress: 0.0 };
        let mut loss = StepLoss::default();
        let mut gradient =
            Gradient { positions: vec![[0.0; 3]; bumps.len()], texels: vec![0.0; model.texture.numbers()], shares: Vec::new() };
        model.view(&pass, (&drawn, &looked, None), &mut probe, &mut loss, &mut gradient);
        let along = gradient.positions.as_flattened().iter().zip(bumps.as_flattened()).map(|(d, b)| (d * b) as f64).sum::<f64>();
        (loss.color, along)
    };
    let (_, along) = loss_at(&model);
    raised(&mut model, &bumps, 0.004);
    let (above, _) = loss_at(&model);
    raised(&mut model, &bumps, -0.008);
    let (below, _) = loss_at(&model);
    let want = (above - below) / 0.008;
    assert!(want < 0.0 && (along / want - 1.0).abs() < 0.1, "{along} {want}");
}
