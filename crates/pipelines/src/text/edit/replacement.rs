//! Edited regions in views: rays that meet a region take its new colors, behind what stands before it,
//! `C = C_front + (1 − a) C_back + a T_front E(u, v, direction)`.

use super::super::field::model::TextModel;
use super::super::label::in_view;
use super::super::placed::PlacedRegion;
use super::super::surface::Rectangle;
use super::Edit;
use super::directions;
use super::texture::Texture;
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::view::View;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::samplers::{RayBatch, pixels};
use diorama_geom::glam::{DVec2, dvec2};
use diorama_geom::{Camera, Image, Pose};
use diorama_kernels::ops::ray_generation::PosedCamera;

/// Rays of a pixel along an axis.
const FOOTPRINT: usize = 4;
/// Share of a pixel below which it is unchanged.
const LEAST: f32 = 1e-4;

/// An edit that is ready to be seen.
pub struct Overlay {
    pub edit: Edit,
    rectangle: Rectangle,
    /// See [`PlacedRegion::front`].
    front: f64,
    /// Of each direction, in the field's colors.
    colors: Vec<Texture>,
    /// Share that is replaced, and share that is a glyph.
    shares: Texture,
}

/// Share of each pixel `[H, W, 1]` that is a glyph.
pub struct Glyphs {
    pub visible: Image,
    /// Whatever stands before them.
    pub whole: Image,
}

/// What a pixel takes from an edit.
struct Replaced {
    pixel: usize,
    /// Distance of the surface in model space.
    distance: f64,
    /// `a`, `a E`, and the share that is a glyph.
    share: f32,
    color: [f32; 3],
    glyph: f32,
}

impl Overlay {
    /// None where the region is on no surface.
    pub fn new(edit: Edit, region: &PlacedRegion) -> Option<Overlay> {
        let rectangle = region.rectangle?;
        let colors = edit.colors.iter().cloned().map(Texture::new).collect();
        let shares = Texture::new(edit.shares.clone());
        Some(Overlay { edit, rectangle, front: region.front, colors, shares })
    }

    /// Place in the textures of reading coordinates.
    fn place(&self, at: DVec2) -> DVec2 {
        let [low, high] = self.edit.frame.map(DVec2::from);
        let share = (at - low) / (high - low);
        dvec2(share.x, 1.0 - share.y)
    }

    /// Pixels of a view that meet the region.
    fn replaced(&self, model: &TextModel, camera: &Camera, pose: &Pose) -> Vec<Replaced> {
        let [low, high] = self.edit.frame.map(DVec2::from);
        let Some(window) = self.window(camera, pose) else { return Vec::new() };
        let weights =
            directions::weights(&self.edit.directions, (self.rectangle.reading_point(DVec2::ZERO) - pose.translation).normalize());
        let margin = (0.5 * (high - low - self.rectangle.reading_size())).max_element().max(0.0);
        let texel = (high - low).x / self.shares.image().width as f64;
        let ray = |x: f64, y: f64| (pose.rotation * camera.direction(x, y)).normalize();
        let mut out = Vec::new();
        for (x, y) in (window[1]..window[3]).flat_map(|y| (window[0]..window[2]).map(move |x| (x, y))) {
            let Some((distance, _)) = self.rectangle.hit(pose.translation, ray(x as f64 + 0.5, y as f64 + 0.5), margin) else { continue };
            let footprint = distance / camera.fx / FOOTPRINT as f64 / texel;
            let (mut share, mut color) = ([0.0f32; 2], [0.0f32; 3]);
            for k in 0..FOOTPRINT * FOOTPRINT {
                let of = |k: usize| (k as f64 + 0.5) / FOOTPRINT as f64;
                let d = ray(x as f64 + of(k % FOOTPRINT), y as f64 + of(k / FOOTPRINT));
                let Some((_, at)) = self.rectangle.hit(pose.translation, d, margin) else { continue };
                if !(at.cmpge(low).all() && at.cmple(high).all()) {
                    continue;
                }
                let (place, mut own) = (self.place(at), [0.0f32; 2]);
                self.shares.add(place, footprint, 1.0 / (FOOTPRINT * FOOTPRINT) as f32, &mut own);
                weights.iter().for_each(|(d, w)| self.colors[*d].add(place, footprint, own[0] * w, &mut color));
                (0..2).for_each(|c| share[c] += own[c]);
            }
            if share[0] > LEAST {
                let pixel = y * camera.width as usize + x;
                let distance = distance * model.model_from_world.scale;
                out.push(Replaced { pixel, distance, share: share[0], color, glyph: share[1] });
            }
        }
        out
    }

    /// Pixels `[x0, y0, x1, y1)` around the region with its margin; none where it is behind the camera or outside of the picture.
    fn window(&self, camera: &Camera, pose: &Pose) -> Option<[usize; 4]> {
        let [low, high] = self.edit.frame.map(DVec2::from);
        let camera_from_world = pose.inverse();
        let steps = 8;
        let (mut from, mut to) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for k in 0..=steps {
            for y in [low.y, high.y] {
                let at = dvec2(low.x + (high.x - low.x) * k as f64 / steps as f64, y);
                let p = camera_from_world.point(self.rectangle.reading_point(at));
                let p = (p.z > 0.0).then(|| camera.project(p)).flatten()?;
                (from, to) = (from.min(p), to.max(p));
            }
        }
        let clamp = |v: f64, most: u32| v.clamp(0.0, most as f64) as usize;
        let (w, h) = (camera.width, camera.height);
        let out = [clamp(from.x - 1.0, w), clamp(from.y - 1.0, h), clamp(to.x.ceil() + 1.0, w), clamp(to.y.ceil() + 1.0, h)];
        (out[0] < out[2] && out[1] < out[3]).then_some(out)
    }

    /// Puts the edit into a view of a camera in the world; returns its glyphs.
    pub fn put(&self, model: &TextModel, camera: &Camera, pose: &Pose, view: &mut View) -> Glyphs {
        let none = Image::zeros(view.rgb.width, view.rgb.height, 1);
        let mut glyphs = Glyphs { visible: none.clone(), whole: none };
        let replaced = self.replaced(model, camera, pose);
        if replaced.is_empty() {
            return glyphs;
        }
        let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
        batch.resize(replaced.len());
        for (i, r) in replaced.iter().enumerate() {
            let (x, y) = (r.pixel % view.rgb.width, r.pixel / view.rgb.width);
            batch.pixels[2 * i..2 * i + 2].copy_from_slice(&[x as f32 + 0.5, y as f32 + 0.5]);
            (batch.images[i], batch.jitter[i]) = (0, 0.5);
        }
        let posed = PosedCamera { camera: *camera, pose: model.model_from_world.pose(pose) };
        pixels::rays(&[posed], model.config.sampling.near, model.cube(), &mut batch);
        for (r, near_far) in replaced.iter().zip(batch.near_far.chunks_exact_mut(2)) {
            let far = in_view::end(model, r.distance, self.front);
            near_far.copy_from_slice(&if far > near_far[0] { [near_far[0], far] } else { [0.0; 2] });
        }
        let front = model.tracer(Quality::Full).trace(&mut batch, &mut buf);
        for (i, r) in replaced.iter().enumerate() {
            let light = 1.0 - front.opacity[i];
            for k in 0..3 {
                let (before, all) = (front.rgb[3 * i + k], &mut view.rgb.data[3 * r.pixel + k]);
                let behind = (*all - before).max(0.0);
                *all = (before + (1.0 - r.share) * behind + light * r.color[k]).clamp(0.0, 1.0);
            }
            let o = &mut view.opacity.data[r.pixel];
            *o = o.max(front.opacity[i] + light * r.share);
            glyphs.visible.data[r.pixel] = light * r.glyph;
            glyphs.whole.data[r.pixel] = r.glyph;
        }
        glyphs
    }
}
