//! Words of a scene as kernels read them.

use super::{light as on_light, surface as on_surface};
use crate::ops::path_trace::bsdf::shares;
use crate::ops::path_trace::geometry::{Affine, Geometry, Mesh, Placed, Tree as Placements};
use crate::ops::path_trace::light::DistantLight;
use crate::ops::path_trace::surface::Surfaces;
use crate::ops::path_trace::vector::V3;
use crate::ops::ray_triangles::binary::{Child, Forest, NOTHING, PLACED};
use crate::ops::ray_triangles::gpu::{PLACEMENT, Tree, words};
use diorama_geom::model::{Material, Opacity, Texture, Wrap};

/// Trees of a scene.
pub struct Trees {
    pub words: Vec<u32>,
    pub all: Tree,
    pub solid: Tree,
    pub porous: Tree,
}

/// The hierarchies of all meshes, those that stand several times under transforms, and trees over them.
pub fn trees(geometry: &Geometry) -> Trees {
    let (mut forest, mut first) = (Forest::default(), 0);
    let mut meshes = Vec::with_capacity(geometry.meshes.len());
    for mesh in &geometry.meshes {
        meshes.push(forest.add(&mesh.bvh, first));
        first += mesh.faces.len() as u32;
    }
    let mut placed = Vec::new();
    let [solid, porous] = [&geometry.solid, &geometry.porous].map(|tree| over(tree, &meshes, &mut forest, &mut placed));
    let mut both: Vec<Child> = [solid, porous].into_iter().flatten().collect();
    let all = (!both.is_empty()).then(|| forest.join(&mut both));
    let deepest = meshes.iter().flatten().map(|c| c.depth).max().unwrap_or(0);
    let below = if placed.is_empty() { 0 } else { deepest };
    let tree = |child: &Option<Child>| Tree::of(child.as_ref(), below);
    Trees { words: words(&forest, &placed), all: tree(&all), solid: tree(&solid), porous: tree(&porous) }
}

/// The tree over placed meshes; none without any.
fn over(tree: &Placements, meshes: &[Option<Child>], forest: &mut Forest, placed: &mut Vec<u32>) -> Option<Child> {
    let mut children = Vec::with_capacity(tree.placed.len());
    for p in &tree.placed {
        let Some(root) = meshes[p.mesh] else { continue };
        if p.is_moved {
            let content = PLACED | (placed.len() / PLACEMENT) as u32;
            children.push(Child { low: p.low, high: p.high, content, depth: 0, ..root });
            placed.extend(placement(p, root.content));
        } else {
            children.push(root);
        }
    }
    (!children.is_empty()).then(|| forest.join(&mut children))
}

fn placement(p: &Placed, root: u32) -> impl Iterator<Item = u32> {
    let of = |m: Affine| m.into_iter().flatten().map(f32::to_bits);
    of(p.mesh_from_world).chain([root]).chain(of(p.world_from_mesh)).chain([p.instance])
}

/// Words of faces, vertices, materials and tables; and texels.
pub fn surfaces(geometry: &Geometry, surfaces: &Surfaces) -> (Vec<u32>, Vec<u32>) {
    let mut out = vec![0; on_surface::HEADER];
    out[on_surface::FACES] = out.len() as u32;
    let mut first = 0;
    for mesh in &geometry.meshes {
        out.extend(
            mesh.faces.iter().flat_map(|f| [f.corners[0] + first, f.corners[1] + first, f.corners[2] + first, f.material, f.instance]),
        );
        first += mesh.vertices.len() as u32;
    }
    out[on_surface::VERTICES] = out.len() as u32;
    out.extend(geometry.meshes.iter().flat_map(vertices));
    out[on_surface::MATERIALS] = out.len() as u32;
    out.extend(surfaces.materials.iter().flat_map(material));
    out[on_surface::TEXTURES] = out.len() as u32;
    let mut texels = Vec::new();
    for t in &surfaces.textures {
        let wrap = |w: Wrap| match w {
            Wrap::Repeat => on_surface::REPEAT,
            Wrap::Mirror => on_surface::MIRROR,
            Wrap::Clamp => on_surface::CLAMP,
        };
        out.extend([texels.len() as u32, t.image.width as u32, t.image.height as u32, wrap(t.wrap[0]), wrap(t.wrap[1])]);
        texels.extend(packed(t));
    }
    out[on_surface::LINEAR] = out.len() as u32;
    out.extend(surfaces.linear.map(f32::to_bits));
    out[on_surface::SHARES] = out.len() as u32;
    out.extend(shares().table.iter().flatten().map(|v| v.to_bits()));
    (out, texels)
}

fn vertices(mesh: &Mesh) -> impl Iterator<Item = u32> {
    mesh.vertices.iter().flat_map(|v| {
        let numbers: Vec<f32> = [&v.position[..], &v.normal, &v.tangent, &v.uv, &v.color].concat();
        numbers.into_iter().map(f32::to_bits)
    })
}

fn material(m: &Material) -> [u32; on_surface::MATERIAL] {
    let mut out = [0; on_surface::MATERIAL];
    let (opacity, cutoff) = match m.opacity {
        Opacity::Opaque => (0, 0.0),
        Opacity::Cutoff(least) => (1, least),
        Opacity::Blend => (2, 0.0),
    };
    let factors = [&m.base_color[..], &[m.roughness, m.metallic, m.specular], &m.emission, &[m.transmission, m.normal_scale]].concat();
    out.iter_mut().zip(&factors).for_each(|(o, v)| *o = v.to_bits());
    (out[on_surface::OPACITY], out[on_surface::CUTOFF]) = (opacity, f32::to_bits(cutoff));
    let textures = [m.base_color_texture, m.metallic_roughness_texture, m.normal_texture, m.emission_texture];
    textures.iter().enumerate().for_each(|(i, t)| out[on_surface::OF_TEXTURES + i] = t.map_or(NOTHING, |t| t as u32));
    out
}

/// Texels of four bytes.
fn packed(t: &Texture) -> impl Iterator<Item = u32> {
    t.image.data.chunks_exact(t.image.channels).map(|p| u32::from_le_bytes([p[0], p[1], p[2], p.get(3).copied().unwrap_or(255)]))
}

/// Words of distant light.
pub fn light(light: &DistantLight) -> Vec<u32> {
    let mut out = vec![0; on_light::HEADER];
    (out[on_light::WIDTH], out[on_light::HEIGHT]) = (light.width as u32, light.height as u32);
    (out[on_light::TURN], out[on_light::SUN_SHARE]) = (light.turn.to_bits(), light.sun_share.to_bits());
    if let Some(sun) = &light.sun {
        out[on_light::SUN] = 1;
        let mut put = |at: usize, v: V3| out[at..at + 3].copy_from_slice(&v.map(f32::to_bits));
        put(on_light::SUN_DIRECTION, sun.direction);
        put(on_light::SUN_RADIANCE, sun.radiance);
        (out[on_light::SUN_CAP], out[on_light::SUN_DENSITY]) = (sun.cap.to_bits(), sun.density.to_bits());
    }
    for (at, steps) in [(on_light::ROWS, &light.rows), (on_light::COLUMNS, &light.columns)] {
        out[at] = out.len() as u32;
        out.extend(steps.sums.iter().map(|v| v.to_bits()));
        out[at + 1] = out.len() as u32;
        out.extend(&steps.guide);
    }
    out[on_light::EDGES] = out.len() as u32;
    out.extend(light.edges.iter().map(|v| v.to_bits()));
    out.extend(light.texels.iter().flatten().map(|v| v.to_bits()));
    out
}
