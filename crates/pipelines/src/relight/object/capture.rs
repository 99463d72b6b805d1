//! Photographs of an object with opacity, their cameras in the object's own space, and where the object is.
//!
//! In object space the object lies within −1 to 1; `x = (world − center) / scale`.

use super::config::Config;
use super::hull;
use super::memory;
use super::placement::Placement;
use crate::error::{PipelineError, Result};
use crate::run::config::Auto;
use diorama_data::import::{self, ImportOptions};
use diorama_data::{DataError, masks, photo};
use diorama_geom::camera::Lens;
use diorama_geom::capture::{Frame, MaskMeaning, MaskRule, Split};
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::{DVec3, DVec4};
use diorama_geom::{Camera, Capture, Image, Pose, Reduction};
use diorama_mesh::tetrahedral_grid::BOX_EDGE;
use rayon::prelude::*;

/// Half the edge of the grid's box in object space.
pub const BOX_HALF: f64 = 0.5 * BOX_EDGE as f64;
/// Nearest and farthest distance that is drawn, in object space: cameras stand outside of the box.
const DEPTH: [f64; 2] = [0.05, 100.0];
/// Largest share of a mask's pixels that may lie outside of the box.
const MAY_BE_CUT: f64 = 0.005;
/// Mean opacity beyond which a mask is taken for a mistake.
const FULL: f64 = 0.95;

/// A camera in object space.
#[derive(Clone, Debug)]
pub struct ObjectView {
    pub camera: Camera,
    pub pose: Pose,
    /// Rows that give clip coordinates of a point; y points down as `rasterize` has it.
    pub clip: [[f32; 4]; 4],
    pub eye: [f32; 3],
}

impl ObjectView {
    pub fn new(camera: Camera, pose: Pose) -> ObjectView {
        let from = pose.inverse();
        // Rows of `camera_from_object`, and of the projection on them.
        let row = |k: usize| DVec4::new(from.rotation.x_axis[k], from.rotation.y_axis[k], from.rotation.z_axis[k], from.translation[k]);
        let (x, y, z) = (row(0), row(1), row(2));
        let (w, h) = (camera.width as f64, camera.height as f64);
        let [near, far] = DEPTH;
        let depth = z * ((far + near) / (far - near)) + DVec4::new(0.0, 0.0, 0.0, -2.0 * far * near / (far - near));
        let rows = [
            x * (2.0 * camera.fx / w) + z * (2.0 * camera.cx / w - 1.0),
            y * (2.0 * camera.fy / h) + z * (2.0 * camera.cy / h - 1.0),
            depth,
            z,
        ];
        ObjectView { camera, pose, clip: rows.map(|r| r.as_vec4().to_array()), eye: pose.translation.as_vec3().to_array() }
    }

    /// The same view with `times` as many pixels along each axis.
    pub fn finer(&self, times: usize) -> ObjectView {
        let (c, k) = (self.camera, times as f64);
        let (width, height) = (c.width * times as u32, c.height * times as u32);
        let camera = Camera { width, height, fx: c.fx * k, fy: c.fy * k, cx: c.cx * k, cy: c.cy * k, ..c };
        ObjectView { camera, ..self.clone() }
    }

    /// Height and width in pixels.
    pub fn size(&self) -> [usize; 2] {
        [self.camera.height as usize, self.camera.width as usize]
    }
}

/// A photograph.
#[derive(Clone, Debug)]
pub struct ObjectPhoto {
    pub name: String,
    /// Linear light, multiplied by the opacity in the fourth channel, `[H, W, 4]`.
    pub rgba: Image,
    pub view: ObjectView,
    pub split: Split,
}

/// All photographs.
pub struct ObjectCapture {
    pub photos: Vec<ObjectPhoto>,
    pub placement: Placement,
    /// Masks of the training photographs, in the world.
    pub silhouettes: Vec<hull::Silhouette>,
}

impl ObjectCapture {
    /// Indices of the photographs of a split.
    pub fn indices(&self, split: Split) -> Vec<usize> {
        (0..self.photos.len()).filter(|i| self.photos[*i].split == split).collect()
    }
}

/// The capture that a configuration names.
///
/// # Errors
/// When it cannot be read.
pub fn import(config: &Config) -> Result<Capture> {
    let options = ImportOptions { split: config.data.split.parse().map_err(PipelineError::Usage)?, ..ImportOptions::default() };
    Ok(import::import(&config.data.path, &options)?)
}

/// Decodes the photographs of a capture and finds the object.
///
/// # Errors
/// When a photograph has no opacity, its mask cannot be right, its lens bends lines, or the object lies outside of the box.
pub fn load(config: &Config, capture: &Capture) -> Result<ObjectCapture> {
    let rule = MaskRule { meaning: MaskMeaning::Object, ..capture.masks };
    let decode = |f: &Frame| {
        let camera = f.camera.reduced(Reduction::Times(config.data.downscale));
        if !is_straight(&camera.lens) {
            let cure = "photographs must be undistorted; diorama prepare, or COLMAP's image_undistorter, makes them so";
            return Err(
                DataError::input(&f.image, format!("its lens bends straight lines, which meshes are not drawn with: {cure}")).into()
            );
        }
        let rgba = opaque_part(f, &rule, (camera.width as usize, camera.height as usize))?;
        Ok((f.name.clone(), rgba, camera, f.world_from_camera, f.split))
    };
    let decoded = capture.frames.par_iter().map(decode).collect::<Result<Vec<_>>>()?;
    let silhouettes: Vec<hull::Silhouette> = decoded
        .iter()
        .filter(|d| d.4 == Split::Train)
        .map(|(_, rgba, camera, pose, _)| hull::Silhouette::new(rgba, *camera, *pose))
        .collect();
    let found = hull::locate(&silhouettes).ok_or_else(|| {
        let cure = "check that poses and masks belong together, and that masks are white on the object";
        DataError::input(&config.data.path, format!("no place in space is inside of all masks: {cure}"))
    })?;
    let placement = match config.grid.scale {
        Auto::Auto => found,
        Auto::Is(scale) => Placement { scale: scale as f64, ..found },
    };
    let photos: Vec<ObjectPhoto> = decoded
        .into_iter()
        .map(|(name, rgba, camera, pose, split)| ObjectPhoto { name, rgba, view: ObjectView::new(camera, placement.pose(&pose)), split })
        .collect();
    check_box(&photos, found.scale)?;
    let pixels = photos.iter().map(|p| p.rgba.width * p.rgba.height).max().unwrap_or(0);
    memory::check(config, photos.len(), pixels, crate::run::memory::available()?)?;
    Ok(ObjectCapture { photos, placement, silhouettes })
}

/// Whether a lens images straight lines as such.
fn is_straight(lens: &Lens) -> bool {
    match lens {
        Lens::Pinhole => true,
        Lens::Brown { k, p } => k == &[0.0; 6] && p == &[0.0; 2],
        _ => false,
    }
}

/// Linear light times opacity of a photograph that is cut out.
fn opaque_part(frame: &Frame, rule: &MaskRule, (width, height): (usize, usize)) -> Result<Image> {
    let is_linear = photo::header(&frame.image)?.color_space() == diorama_geom::capture::ColorSpace::Linear;
    let (photo, _) = masks::apply(frame, rule, photo::load_full(&frame.image)?)?;
    if photo.channels() != 4 {
        let expected = "expected RGBA photographs, or masks (white on the object) in masks/ beside images/";
        return Err(DataError::input(&frame.image, format!("has no opacity: what belongs to the object is not known; {expected}")).into());
    }
    let mut image = match photo.downsampled(width, height) {
        photo::Photo::Linear(im) if is_linear => im,
        other => {
            let mut im = other.into_srgb();
            im.data.as_chunks_mut::<4>().0.iter_mut().for_each(|p| (0..3).for_each(|k| p[k] = linear_from_srgb(p[k])));
            im
        }
    };
    image.data.as_chunks_mut::<4>().0.iter_mut().for_each(|p| (0..3).for_each(|k| p[k] *= p[3]));
    let mean = image.data.as_chunks::<4>().0.iter().map(|p| p[3] as f64).sum::<f64>() / (image.width * image.height) as f64;
    if mean > FULL || mean == 0.0 {
        let file = frame.mask.as_ref().unwrap_or(&frame.image);
        let what = format!("its mask covers {:.1} % of the picture", 100.0 * mean);
        return Err(
            DataError::input(file, format!("{what}; the object must be cut out, white on the object (is the mask inverted?)")).into()
        );
    }
    Ok(image)
}

/// Refuses a box that the object leaves.
fn check_box(photos: &[ObjectPhoto], suggested: f64) -> Result<()> {
    let of = |p: &ObjectPhoto| {
        let (mut cut, mut all) = (0usize, 0usize);
        for (i, pixel) in p.rgba.data.as_chunks::<4>().0.iter().enumerate().filter(|(_, p)| p[3] > 0.5) {
            let (x, y) = ((i % p.rgba.width) as f64 + 0.5, (i / p.rgba.width) as f64 + 0.5);
            let d = p.view.pose.rotation * p.view.camera.direction(x, y);
            cut += !meets_box(p.view.pose.translation, d) as usize;
            all += (pixel[3] > 0.5) as usize;
        }
        (cut, all)
    };
    let counts: Vec<(usize, usize)> = photos.par_iter().filter(|p| p.split == Split::Train).map(of).collect();
    let (cut, all) = counts.iter().fold((0, 0), |(a, b), (c, n)| (a + c, b + n));
    if cut as f64 > MAY_BE_CUT * all as f64 {
        let views = counts.iter().filter(|(c, _)| *c > 0).count();
        let share = 100.0 * cut as f64 / all as f64;
        return Err(PipelineError::Usage(format!(
            "the grid does not enclose the object: {cut} pixels of the masks ({share:.1} %) in {views} photographs lie outside; \
             use --set grid.scale={suggested:.3}, or auto"
        )));
    }
    Ok(())
}

fn meets_box(origin: DVec3, direction: DVec3) -> bool {
    let (mut near, mut far) = (0.0f64, f64::INFINITY);
    for k in 0..3 {
        let [a, b] = [-BOX_HALF, BOX_HALF].map(|side| (side - origin[k]) / direction[k]);
        (near, far) = (near.max(a.min(b)), far.min(a.max(b)));
    }
    near <= far
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clip_coordinates_agree_with_the_camera() {
        let mut camera = Camera::pinhole(64, 48, 0.8);
        (camera.cx, camera.cy) = (30.0, 27.0);
        let view = ObjectView::new(camera, Pose::look_at(DVec3::new(3.0, -2.0, 1.0), DVec3::new(0.1, 0.0, 0.0), DVec3::Z));
        for p in [[0.0, 0.1, -0.3], [0.5, -0.4, 0.2]] {
            let c: Vec<f32> = view.clip.iter().map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3]).collect();
            let want = camera.project(view.pose.inverse().point(DVec3::from(p.map(f64::from)))).unwrap();
            let got = [(c[0] / c[3] + 1.0) * 32.0, (c[1] / c[3] + 1.0) * 24.0];
            assert!((got[0] as f64 - want.x).abs() < 1e-3 && (got[1] as f64 - want.y).abs() < 1e-3, "{got:?} {want}");
            assert!((-1.0..1.0).contains(&(c[2] / c[3])));
            let fine = view.finer(2);
            let there = fine.camera.project(fine.pose.inverse().point(DVec3::from(p.map(f64::from)))).unwrap();
            assert!(fine.clip == view.clip && (there - 2.0 * want).length() < 1e-9, "{there} {want}");
        }
    }
}
