//! Glass of a site: faces that masks mark become a smooth, dark dielectric, which mirrors the light and hides what is behind.

use super::super::outdoor::model::SceneModel;
use crate::error::Result;
use diorama_data::masks::{self, COUNTS, GLASS, SKY};
use diorama_geom::capture::Frame;
use diorama_geom::glam::{DAffine3, DVec3};
use diorama_geom::model::{Instance, Material, Part};
use diorama_geom::{ImageU8, Mesh, Model, Pose, Similarity};
use diorama_mesh::visibility::CameraVisibility;
use rayon::prelude::*;

/// Base color of a pane before a dark room, and its roughness.
const DARK: f32 = 0.02;
const ROUGHNESS: f32 = 0.03;

/// Training views with masks of glass.
pub struct GlassViews<'a> {
    /// Each with its mask, at the frame's size.
    views: Vec<(&'a Frame, ImageU8)>,
    mesh_from_world: Similarity,
    /// Error of the surface in units of the mesh, for visibility.
    slack: f32,
    /// A line where masks are gone.
    pub note: Option<String>,
}

impl<'a> GlassViews<'a> {
    /// The masks of frames, for meshes in the capture's coordinates; no views where no mask marks glass.
    ///
    /// # Errors
    /// When a mask cannot be decoded or does not fit its photograph.
    pub fn read(model: &SceneModel, frames: &[&'a Frame], slack: f32) -> Result<GlassViews<'a>> {
        let (there, gone): (Vec<&Frame>, Vec<&Frame>) =
            frames.iter().filter(|f| f.mask.is_some()).partition(|f| f.mask.as_ref().is_some_and(|m| m.is_file()));
        let note = gone.first().and_then(|f| f.mask.as_ref()).map(|first| {
            format!("{} of {} masks are gone, the first is {}: glass is told by the others", gone.len(), frames.len(), first.display())
        });
        let read = |f: &&'a Frame| {
            let mask = masks::of_frame(f, &model.capture.masks, (f.camera.width as usize, f.camera.height as usize))?;
            Ok(mask.map(|m| (*f, m)))
        };
        let mut views: Vec<_> = there.par_iter().map(read).collect::<Result<Vec<_>>>()?.into_iter().flatten().collect();
        if !views.iter().any(|(_, m)| m.data.iter().any(|v| GLASS.contains(v))) {
            views.clear();
        }
        Ok(GlassViews { views, mesh_from_world: model.capture.world_from_capture.inverse(), slack, note })
    }

    /// Whether each face is glass in most of the views that see it.
    fn faces(&self, mesh: &Mesh) -> Vec<bool> {
        if self.views.is_empty() {
            return vec![false; mesh.faces.len()];
        }
        let centers: Vec<[f32; 3]> = mesh.faces.iter().map(|f| center(mesh, f)).collect();
        let votes = |(frame, mask): &(&Frame, ImageU8)| -> Vec<i32> {
            let pose = self.mesh_from_world.pose(&frame.world_from_camera);
            let visibility = CameraVisibility::new(mesh, &frame.camera, &pose);
            let of = |p: &[f32; 3]| if visibility.sees(*p, self.slack) { vote(frame, mask, &pose, p) } else { 0 };
            centers.iter().map(of).collect()
        };
        let add = |a: Vec<i32>, b: Vec<i32>| a.iter().zip(&b).map(|(a, b)| a + b).collect();
        let sums = self.views.par_iter().map(votes).reduce(|| vec![0; centers.len()], add);
        sums.into_iter().map(|v| v > 0).collect()
    }

    /// A mesh as a model whose panes are a part of their own, and the number of their faces.
    pub fn model(&self, name: &str, mesh: Mesh) -> (Model, usize) {
        let is_glass = self.faces(&mesh);
        let count = is_glass.iter().filter(|g| **g).count();
        if count == 0 {
            return (Model::of(name, mesh), 0);
        }
        let part = |glass: bool| {
            let mut part = mesh.clone();
            let mut each = is_glass.iter();
            part.faces.retain(|_| each.next() == Some(&glass));
            part.compact();
            part
        };
        let panes = Mesh { uvs: Vec::new(), texture: None, ..part(true) };
        let mut model = Model::of(name, part(false));
        let material = Material { name: "glass".into(), base_color: [DARK, DARK, DARK, 1.0], roughness: ROUGHNESS, ..Material::default() };
        model.materials.push(material);
        model.parts.push(Part { name: "glass".into(), mesh: panes, material: 1 });
        model.instances.push(Instance { part: 1, world_from_part: DAffine3::IDENTITY });
        (model, count)
    }
}

/// 1 where a view shows glass at a point, -1 where it shows something else that stays, else 0.
fn vote(frame: &Frame, mask: &ImageU8, pose: &Pose, p: &[f32; 3]) -> i32 {
    let Some(at) = frame.camera.project(pose.inverse().point(DVec3::from(p.map(f64::from)))) else { return 0 };
    let (x, y) = ((at.x.max(0.0) as usize).min(mask.width - 1), (at.y.max(0.0) as usize).min(mask.height - 1));
    match mask.pixel(x, y)[0] {
        v if GLASS.contains(&v) => 1,
        v if v >= COUNTS && !SKY.contains(&v) => -1,
        _ => 0,
    }
}

fn center(mesh: &Mesh, face: &[u32; 3]) -> [f32; 3] {
    let [a, b, c] = face.map(|i| mesh.positions[i as usize]);
    std::array::from_fn(|k| (a[k] + b[k] + c[k]) / 3.0)
}
