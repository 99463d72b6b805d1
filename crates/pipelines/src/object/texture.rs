//! Colours of a mesh's texels as the training cameras see them through the field.

use super::model::ObjectModel;
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::volume::{Backdrop, Quality};
use diorama_engine::samplers::RayBatch;
use diorama_geom::Mesh;
use diorama_geom::field_query::FieldQuery;
use diorama_geom::glam::DVec3;
use diorama_mesh::bake::{self, DepthMap};

/// Most cameras that are asked.
const CAMERAS: usize = 240;
/// Longest side of the maps that tell what a camera sees.
const MAP_PX: u32 = 640;
/// Cameras that are considered for a face, and that colour a texel.
const CONSIDERED: usize = 16;
const ASKED: usize = 4;
/// A view counts from this cosine to the surface's normal on.
const STEEPEST: f32 = 0.2;
/// Cells before and behind the surface whose light makes a texel.
const REACH: f32 = 3.0;
/// Rays that are traced at once.
const RAYS: usize = 1 << 16;

/// Bakes `mesh`, whose texture coordinates and normals are set, into a texture of `size × size`; `cell` is the edge of the cells
/// it was extracted with. Each texel is the mean of what the cameras that face it see within [`REACH`] cells of the surface.
/// `progress` receives texels done, of all.
pub fn bake(model: &ObjectModel, mesh: &mut Mesh, size: usize, cell: f32, progress: &mut dyn FnMut(usize, usize)) {
    let texels = bake::texels(mesh, size);
    let maps = depth_maps(model, mesh);
    let considered = candidates(&maps, mesh);
    // Negative: nobody has seen it.
    let mut rgb = vec![[-1.0f32; 3]; texels.index.len()];
    let at_once = RAYS / ASKED;
    let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
    for first in (0..rgb.len()).step_by(at_once) {
        let last = (first + at_once).min(rgb.len());
        let asked = asked(&texels, first..last, &maps, &considered, cell);
        trace(model, &texels.positions, &maps, &asked, cell, (&mut batch, &mut buf), &mut rgb);
        progress(last, rgb.len());
    }
    // What nobody sees takes on the colours around it.
    if rgb.iter().all(|c| c[0] < 0.0) {
        let inward: Vec<[f32; 3]> = texels.normals.iter().map(|n| n.map(|v| -v)).collect();
        model.color(&texels.positions, &inward, &mut rgb);
    }
    mesh.texture = Some(bake::texture(&texels, &rgb, size));
}

/// What each training camera sees of the mesh.
fn depth_maps(model: &ObjectModel, mesh: &Mesh) -> Vec<DepthMap> {
    use rayon::prelude::*;
    let n = model.train.len();
    let chosen: Vec<usize> = (0..n.min(CAMERAS)).map(|i| model.train[i * n / n.min(CAMERAS)]).collect();
    let map = |i: &usize| {
        let f = &model.capture.frames[*i];
        let shrink = f.camera.width.max(f.camera.height).div_ceil(MAP_PX);
        DepthMap::new(mesh, f.camera.downscaled(shrink), &f.world_from_camera)
    };
    chosen.par_iter().map(map).collect()
}

/// The cameras that stand best before each face, best first.
fn candidates(maps: &[DepthMap], mesh: &Mesh) -> Vec<Vec<(u16, f32)>> {
    use rayon::prelude::*;
    let eyes: Vec<DVec3> = maps.iter().map(DepthMap::eye).collect();
    let of = |f: &[u32; 3]| {
        let mean = |v: &[[f32; 3]]| f.iter().map(|i| DVec3::from(v[*i as usize].map(f64::from))).sum::<DVec3>() / 3.0;
        let (p, n) = (mean(&mesh.positions), mean(&mesh.normals).normalize_or_zero());
        let mut scored: Vec<(u16, f32)> = eyes
            .iter()
            .enumerate()
            .filter_map(|(i, eye)| {
                let to = *eye - p;
                let cosine = (to.normalize().dot(n)) as f32;
                (cosine > STEEPEST).then(|| (i as u16, cosine * cosine / to.length_squared() as f32))
            })
            .collect();
        scored.sort_by(|a, b| b.1.total_cmp(&a.1));
        scored.truncate(CONSIDERED);
        scored
    };
    mesh.faces.par_iter().map(of).collect()
}

/// A ray from a camera to a texel, and how much it counts.
struct Asked {
    texel: u32,
    camera: u16,
    weight: f32,
}

/// The best cameras that see each texel.
fn asked(texels: &bake::Texels, range: std::ops::Range<usize>, maps: &[DepthMap], considered: &[Vec<(u16, f32)>], cell: f32) -> Vec<Asked> {
    use rayon::prelude::*;
    let of = |i: usize| {
        let seen = considered[texels.face[i] as usize].iter().filter(move |(c, _)| maps[*c as usize].sees(texels.positions[i], 1.5 * cell));
        seen.take(ASKED).map(move |(c, w)| Asked { texel: i as u32, camera: *c, weight: *w })
    };
    range.into_par_iter().flat_map_iter(of).collect()
}

/// Traces rays near the surface and writes texels' weighted means; texels that nobody sees become negative.
fn trace(
    model: &ObjectModel,
    positions: &[[f32; 3]],
    maps: &[DepthMap],
    asked: &[Asked],
    cell: f32,
    (batch, buf): (&mut RayBatch, &mut FieldBuffers),
    rgb: &mut [[f32; 3]],
) {
    let to_model = model.model_from_world;
    let reach = REACH * cell * to_model.scale as f32;
    let mut tracer = model.tracer(Quality::Full);
    tracer.backdrop = Backdrop::Color([0.0; 3]);
    tracer.near = 0.0;
    batch.resize(asked.len());
    for (r, a) in asked.iter().enumerate() {
        let p = to_model.point(DVec3::from(positions[a.texel as usize].map(f64::from)));
        let eye = to_model.point(maps[a.camera as usize].eye());
        let (d, far) = ((p - eye).normalize(), (p - eye).length() as f32);
        batch.origins[r * 3..r * 3 + 3].copy_from_slice(&eye.as_vec3().to_array());
        batch.dirs[r * 3..r * 3 + 3].copy_from_slice(&d.as_vec3().to_array());
        batch.near_far[r * 2] = (far - reach).max(0.0);
        batch.near_far[r * 2 + 1] = far + reach;
        batch.jitter[r] = 0.5;
        batch.images[r] = 0;
    }
    let seen = tracer.trace(batch, buf);
    let mut r = 0;
    while r < asked.len() {
        let texel = asked[r].texel;
        let (mut sum, mut total) = ([0.0f32; 3], 0.0);
        while r < asked.len() && asked[r].texel == texel {
            let w = asked[r].weight * seen.opacity[r];
            if seen.opacity[r] > 0.2 {
                (0..3).for_each(|k| sum[k] += asked[r].weight * seen.rgb[r * 3 + k]);
                total += w;
            }
            r += 1;
        }
        rgb[texel as usize] = [-1.0; 3];
        if total > 0.0 {
            let mut mean = [sum.map(|v| v / total)];
            model.encode(&mut mean);
            [rgb[texel as usize]] = mean;
        }
    }
}
