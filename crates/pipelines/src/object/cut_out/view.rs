//! One photograph: what the mesh covers in it, what hides the mesh, and the picture with that opacity.

use super::super::model::ObjectModel;
use crate::error::Result;
use crate::run::undistort;
use diorama_data::{DataError, masks, photo, photo::Photo};
use diorama_engine::renderers::volume::{Backdrop, Quality};
use diorama_geom::capture::MaskMeaning;
use diorama_geom::capture::{ColorSpace, Frame};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, ImageU8, Lens, Mesh, OrientedBox, Pose};
use diorama_mesh::bake::DepthMap;
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// Longest side in pixels of the views that tell what hides the mesh.
const VIEW_PX: f64 = 48.0;
/// Samples per pixel and axis of the opacity, and those of large photographs.
const SAMPLES: (u32, u32) = (4, 2);
const LARGE: u32 = 1 << 20;
/// Share of the picture below and above which the object is not seen, or nothing else.
const COVERS: (f64, f64) = (2e-4, 0.9);
/// Share of the mesh's pixels that may be hidden.
const MAY_BE_HIDDEN: f64 = 0.05;
/// What lies farther in front of the mesh than this share of its diagonal may hide it.
const IN_FRONT: f64 = 0.02;

/// Why a photograph is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeftOut {
    /// The object is outside of the picture.
    Absent,
    /// The object fills the picture, or the camera stands within its box.
    Filled,
    /// Something stands in front of the object, or a mask leaves open what is there.
    Hidden,
}

/// A photograph after it was cut.
pub struct Shown {
    pub frame: std::result::Result<Frame, LeftOut>,
    /// Sum of the field's opacity where the mesh is, over `covered` pixels of a small view.
    pub opacity: f64,
    pub covered: usize,
}

/// Cuts photographs by a mesh in the world.
pub struct Cutter<'a> {
    model: &'a ObjectModel,
    mesh: &'a Mesh,
    bounds: (DVec3, DVec3),
    /// Folder of the pictures, and their names without extension.
    images: &'a Path,
    names: Vec<String>,
    /// Cameras of all frames, corrected where training has corrected them.
    cameras: Vec<(Camera, Pose)>,
}

impl<'a> Cutter<'a> {
    pub fn new(model: &'a ObjectModel, mesh: &'a Mesh, images: &'a Path) -> Cutter<'a> {
        let (lo, hi) = mesh.bounds().unwrap_or_default();
        let world_from_model = model.model_from_world.inverse();
        let n = model.capture.frames.len();
        let mut posed: Vec<_> = (0..n).map(|i| model.posed(i)).collect();
        for (i, corrected) in model.train.iter().zip(model.cameras()) {
            posed[*i] = corrected;
        }
        Cutter {
            model,
            mesh,
            bounds: (DVec3::from(lo.map(f64::from)), DVec3::from(hi.map(f64::from))),
            images,
            names: names(&model.capture.frames),
            cameras: posed.into_iter().map(|p| (p.camera, world_from_model.pose(&p.pose))).collect(),
        }
    }

    pub fn len(&self) -> usize {
        self.cameras.len()
    }

    /// Cuts photograph `i` and writes it.
    ///
    /// # Errors
    /// When it cannot be read or written, or no pinhole camera can replace its lens.
    pub fn cut(&self, i: usize) -> Result<Shown> {
        let (from, pose) = self.cameras[i];
        let frame = &self.model.capture.frames[i];
        let to = flat(&from).ok_or_else(|| {
            DataError::input(&frame.image, "its lens sees too wide an angle for a flat picture, which meshes are drawn in; leave it out")
        })?;
        let out = |why| Ok(Shown { frame: Err(why), opacity: 0.0, covered: 0 });
        let margin = IN_FRONT * (self.bounds.1 - self.bounds.0);
        if pose.translation.cmpgt(self.bounds.0 - margin).all() && pose.translation.cmplt(self.bounds.1 + margin).all() {
            return out(LeftOut::Filled);
        }
        let coverage = self.coverage(&to, &pose);
        let share = coverage.iter().map(|v| *v as f64).sum::<f64>() / coverage.len() as f64;
        if share < COVERS.0 {
            return out(LeftOut::Absent);
        }
        let (opacity, covered, hidden) = self.around(&to, &pose);
        let shown = |frame| Ok(Shown { frame, opacity, covered });
        if hidden {
            return shown(Err(LeftOut::Hidden));
        }
        if share > COVERS.1 {
            return shown(Err(LeftOut::Filled));
        }
        let Some(picture) = self.picture(frame, &from, &to, &coverage)? else { return shown(Err(LeftOut::Hidden)) };
        let extension = if matches!(picture, Photo::Linear(_)) { "exr" } else { "png" };
        let image: PathBuf = self.images.join(format!("{}.{extension}", self.names[i]));
        match picture {
            Photo::Linear(im) => photo::save_exr(&image, &im)?,
            other => photo::save_png(&image, &other.into_8_bits())?,
        }
        let name = format!("images/{}", self.names[i]);
        shown(Ok(Frame { split: frame.split, color_space: frame.color_space, ..Frame::new(name, image, to, pose) }))
    }

    /// Share of each pixel that the mesh covers.
    fn coverage(&self, camera: &Camera, pose: &Pose) -> Vec<f32> {
        let times = if camera.width * camera.height > LARGE { SAMPLES.1 } else { SAMPLES.0 };
        let (w, k) = (camera.width as usize, times as usize);
        let fine = camera.resized(camera.width * times, camera.height * times);
        let depth = DepthMap::new(self.mesh, fine, pose);
        let mut share = vec![0.0f32; w * camera.height as usize];
        for (y, row) in depth.depth().chunks_exact(w * k).enumerate() {
            for (x, d) in row.iter().enumerate() {
                share[y / k * w + x / k] += d.is_finite() as u32 as f32;
            }
        }
        share.iter_mut().for_each(|v| *v /= (k * k) as f32);
        share
    }

    /// In a small view: the sum of the field's opacity where the mesh is, the number of those pixels, and whether something hides too many of
    /// them.
    fn around(&self, camera: &Camera, pose: &Pose) -> (f64, usize, bool) {
        let small = small(camera, VIEW_PX);
        let depth = DepthMap::new(self.mesh, small, pose);
        let is_covered: Vec<bool> = depth.depth().iter().map(|d| d.is_finite()).collect();
        let posed = self.model.to_model(small, pose);
        let (lo, hi) = self.bounds;
        let mut tracer = self.model.tracer(Quality::Fast);
        tracer.backdrop = Backdrop::Color([0.0; 3]);
        tracer.clip = Some((in_model(self.model, lo.as_vec3().to_array()), in_model(self.model, hi.as_vec3().to_array())));
        let inside = tracer.view(&posed, &mut |_| {});
        // Everything before the nearest point of the mesh.
        let corner = |c: usize| DVec3::new([lo.x, hi.x][c & 1], [lo.y, hi.y][c >> 1 & 1], [lo.z, hi.z][c >> 2]);
        let away = |p: DVec3| (p - pose.translation).dot(pose.rotation.z_axis);
        let nearest = (0..8).map(|c| away(corner(c))).fold(f64::INFINITY, f64::min) - IN_FRONT * (hi - lo).length();
        let deep = nearest * self.model.model_from_world.scale;
        let hidden = (deep > 0.0).then(|| {
            tracer.clip = None;
            let place = Pose { translation: posed.pose.translation + 0.5 * deep * posed.pose.rotation.z_axis, ..posed.pose };
            tracer.crop = Some(OrientedBox { place, sides: DVec3::new(1e3 * deep, 1e3 * deep, deep) });
            tracer.view(&posed, &mut |_| {})
        });
        let of_mesh = || (0..is_covered.len()).filter(|i| is_covered[*i]);
        let n = of_mesh().count();
        let opacity = of_mesh().map(|i| inside.opacity.data[i] as f64).sum();
        let behind = hidden.map_or(0, |v| of_mesh().filter(|i| v.opacity.data[*i] > 0.5).count());
        (opacity, n, behind as f64 > MAY_BE_HIDDEN * n as f64)
    }

    /// The photograph of a flat lens, with its own opacity, else the mesh's; none where its mask leaves open too much of the mesh.
    fn picture(&self, frame: &Frame, from: &Camera, to: &Camera, coverage: &[f32]) -> Result<Option<Photo>> {
        let (w, h) = (to.width as usize, to.height as usize);
        let (rule, photo) = (&self.model.capture.masks, photo::load_full(&frame.image)?);
        // Of its own, or by masks of objects: a sky that masks mark as transparent leaves much besides the object.
        let is_cut_out = has_opacity(&photo) || (rule.meaning == MaskMeaning::Object && frame.mask.is_some());
        let (decoded, open) = masks::apply(frame, rule, photo)?;
        let mut picture = decoded.downsampled(w, h);
        let mut open = open.map(|m| m.downsampled(w, h));
        let is_linear = matches!(&picture, Photo::Linear(_)) && frame.color_space == ColorSpace::Linear;
        if from.lens != to.lens && is_linear {
            let what =
                "holds linear light seen by a lens that bends lines, which cannot be made flat here; undistort the photographs first";
            return Err(DataError::input(&frame.image, what).into());
        }
        if from.lens != to.lens {
            picture = Photo::Eight(undistort::undistorted(&picture.into_8_bits(), from, to));
            open = open.map(|m| undistort::undistorted(&m, from, to));
        } else if !is_linear {
            picture = Photo::Eight(picture.into_8_bits());
        }
        if let Some(open) = open {
            let of_mesh = || (0..w * h).filter(|i| coverage[*i] > 0.5);
            let hidden = of_mesh().filter(|i| open.data[*i] < masks::COUNTS).count();
            if hidden as f64 > MAY_BE_HIDDEN * of_mesh().count() as f64 {
                return Ok(None);
            }
        }
        Ok(Some(if is_cut_out { picture } else { with_opacity(&picture, coverage) }))
    }
}

/// A point of the world in model space.
fn in_model(model: &ObjectModel, p: [f32; 3]) -> [f32; 3] {
    model.model_from_world.point(DVec3::from(p.map(f64::from))).as_vec3().to_array()
}

/// A camera with at most `longest` pixels along the longest side.
fn small(camera: &Camera, longest: f64) -> Camera {
    let shrink = (longest / camera.width.max(camera.height) as f64).min(1.0);
    let side = |n: u32| ((n as f64 * shrink).round() as u32).max(1);
    camera.resized(side(camera.width), side(camera.height))
}

/// A pinhole camera in place of one whose lens bends lines; none where no pinhole camera can replace it.
fn flat(camera: &Camera) -> Option<Camera> {
    match camera.lens {
        Lens::Pinhole => Some(*camera),
        _ => undistort::pinhole(camera),
    }
}

/// Whether any pixel is transparent.
fn has_opacity(p: &Photo) -> bool {
    match p {
        Photo::Eight(im) => im.channels == 4 && im.data.as_chunks::<4>().0.iter().any(|p| p[3] < 255),
        Photo::Sixteen(im) | Photo::Linear(im) => im.channels == 4 && im.data.as_chunks::<4>().0.iter().any(|p| p[3] < 1.0),
    }
}

/// A picture of one, three or four channels with another opacity.
fn with_opacity(picture: &Photo, alpha: &[f32]) -> Photo {
    fn joined<T: Copy>(data: &[T], channels: usize, alpha: impl Iterator<Item = T>) -> Vec<T> {
        let color = |p: &[T]| if channels < 3 { [p[0]; 3] } else { [p[0], p[1], p[2]] };
        data.chunks_exact(channels)
            .zip(alpha)
            .flat_map(|(p, a)| {
                let c = color(p);
                [c[0], c[1], c[2], a]
            })
            .collect()
    }
    match picture {
        Photo::Eight(im) => {
            let data = joined(&im.data, im.channels, alpha.iter().map(|a| diorama_geom::color::u8_from_unit(*a)));
            Photo::Eight(ImageU8 { data, channels: 4, ..*im })
        }
        Photo::Sixteen(im) => {
            let data = joined(&im.data, im.channels, alpha.iter().copied());
            Photo::Sixteen(diorama_geom::Image { data, channels: 4, ..*im })
        }
        Photo::Linear(im) => {
            let data = joined(&im.data, im.channels, alpha.iter().copied());
            Photo::Linear(diorama_geom::Image { data, channels: 4, ..*im })
        }
    }
}

/// Names of the photographs' files without extension; those that come twice, or differ in case alone, begin with their number.
fn names(frames: &[Frame]) -> Vec<String> {
    let mut seen = HashSet::new();
    let stem = |f: &Frame| f.image.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    frames
        .iter()
        .enumerate()
        .map(|(i, f)| {
            let name = stem(f);
            if !name.is_empty() && seen.insert(name.to_lowercase()) { name } else { format!("{i:05}_{name}") }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photographs_of_one_name_in_two_folders_do_not_replace_each_other() {
        let frame = |image: &str| Frame::new("", image, Camera::pinhole(4, 4, 1.0), Pose::IDENTITY);
        let frames = ["left/a.jpg", "right/A.jpg", "b.png", "b.jpg"].map(frame);
        assert_eq!(names(&frames), ["a", "00001_A", "b", "00003_b"]);
    }

    #[test]
    fn opacity_replaces_that_of_pictures_of_any_channels() {
        for channels in [1, 3, 4] {
            let data = (0..2 * channels).map(|i| 10 * i as u8).collect();
            let Photo::Eight(out) = with_opacity(&Photo::Eight(ImageU8 { width: 2, height: 1, channels, data }), &[1.0, 0.5]) else {
                panic!("the depth stays")
            };
            let step = if channels == 1 { 0 } else { 10 };
            assert!(out.channels == 4 && out.data[..4] == [0, step, 2 * step, 255] && out.data[7] == 128, "{:?}", out.data);
        }
    }
}
