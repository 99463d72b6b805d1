//! Labels without learned classes or surfaces, as a baseline: outlines of labelled photographs are carried to other views by a homography,
//! fitted to pixels that depth takes there and back and to sparse points that both photographs show (Cui et al. 2024, released code).

use super::super::field::label_maps::{contains, round_trip};
use super::super::field::model::TextModel;
use super::super::regions::{clipped, shortest_side};
use super::super::surface::plane_rectangle;
use super::LabelledView;
use super::homography::{self, Match};
use super::in_view::{LEAST_VISIBLE, READABLE, READABLE_PX, area};
use diorama_data::text_labels::{self, LabelledRegion, UNREADABLE};
use diorama_data::text_set::SetWord;
use diorama_engine::renderers::view::View;
use diorama_geom::Camera;
use diorama_geom::glam::{DMat3, DVec2};
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::sync::atomic::{AtomicBool, Ordering};

/// Fewest matches of a homography.
const FEWEST: usize = 12;

/// A labelled photograph, with its depths.
struct Source {
    frame: usize,
    camera: PosedCamera,
    view: View,
}

/// Carries labels of the labelled training photographs to other views.
pub struct Stereo<'a> {
    model: &'a TextModel,
    sources: Vec<Source>,
}

impl<'a> Stereo<'a> {
    /// Renders the depths of the labelled photographs; none after an interrupt.
    pub fn new(model: &'a TextModel, stop: &AtomicBool, progress: &mut dyn FnMut(f64, &str)) -> Option<Stereo<'a>> {
        let labelled: Vec<usize> = model.train.iter().copied().filter(|f| model.labels.of_frame[*f].is_some()).collect();
        let mut sources = Vec::new();
        for (k, frame) in labelled.iter().enumerate() {
            if stop.load(Ordering::Relaxed) {
                return None;
            }
            progress(k as f64 / labelled.len() as f64, "depths of labelled photographs");
            let camera = model.posed(*frame);
            sources.push(Source { frame: *frame, view: model.surface_view(&camera), camera });
        }
        Some(Stereo { model, sources })
    }

    /// Labels of a view, whose capture's frame is given if it is a photograph: of each region from the labelled photograph with most matches.
    pub(super) fn words(&self, to: &LabelledView) -> Vec<SetWord> {
        let camera = super::posed(self.model, to);
        let view = self.model.surface_view(&camera);
        let carried = |id: &u32| {
            let of = |s: &Source| self.carried(s, *id, to.frame, (&camera, &view)).map(|c| (c.inliers, c));
            self.sources.iter().filter_map(of).reduce(|a, b| if b.0 > a.0 { b } else { a })
        };
        let ids = self.model.labels.classes.iter().map(|c| c.id);
        ids.filter_map(|id| word(&carried(&id)?.1, &to.camera)).collect()
    }

    /// A region of a labelled photograph, carried to a view.
    fn carried(&self, from: &Source, id: u32, frame: Option<usize>, (camera, view): (&PosedCamera, &View)) -> Option<Carried<'_>> {
        let image = self.model.labels.of_frame[from.frame].as_ref()?;
        let region = image.regions.iter().find(|r| r.id == id && !r.ignore)?;
        // Labels are in pixels of the capture, depths in those of the run.
        let of = &self.model.capture.frames[from.frame].camera;
        let scale = DVec2::new(from.camera.camera.width as f64 / of.width as f64, from.camera.camera.height as f64 / of.height as f64);
        let polygon: Vec<DVec2> = region.polygon.iter().map(|p| DVec2::from(*p) * scale).collect();
        let (w, h) = (from.camera.camera.width as usize, from.camera.camera.height as usize);
        let pixels = (0..w * h).map(|i| DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)).filter(|p| contains(&polygon, *p));
        let (mut matches, mut all): (Vec<Match>, usize) = (Vec::new(), 0);
        for p in pixels {
            all += 1;
            matches.extend(round_trip((&from.camera, &from.view), (camera, view), p).map(|(_, there)| (p, there)));
        }
        let visibility = matches.len() as f64 / all.max(1) as f64;
        matches.extend(frame.into_iter().flat_map(|to| self.shared(from, to, &polygon, camera)));
        let (h, inliers) = homography::ransac(&matches, id as u64)?;
        (inliers >= FEWEST).then_some(Carried { region, polygon, homography: h, inliers, visibility })
    }

    /// Sparse points in a polygon that both photographs show.
    fn shared(&self, from: &Source, to: usize, polygon: &[DVec2], camera: &PosedCamera) -> Vec<Match> {
        let shows = |frames: &[u32]| [from.frame, to].iter().all(|f| frames.contains(&(*f as u32)));
        let at = |c: &PosedCamera, p| {
            let q = c.pose.inverse().point(self.model.model_from_world.point(p));
            (q.z > 0.0).then(|| c.camera.project(q)).flatten()
        };
        let points = self.model.capture.points.iter().filter(|p| shows(&p.frames));
        let matched = points.filter_map(|p| Some((at(&from.camera, p.position)?, at(camera, p.position)?)));
        matched.filter(|(p, _)| contains(polygon, *p)).collect()
    }
}

/// A region's outline on its way to a view.
struct Carried<'a> {
    region: &'a LabelledRegion,
    polygon: Vec<DVec2>,
    homography: DMat3,
    inliers: usize,
    /// Share of its pixels that the view shows.
    visibility: f64,
}

/// The label of a carried region; none where less than [`LEAST_VISIBLE`] of it is visible.
fn word(carried: &Carried, camera: &Camera) -> Option<SetWord> {
    let size = [camera.width as f64, camera.height as f64];
    let outline: Vec<[f64; 2]> =
        carried.polygon.iter().map(|p| homography::apply(&carried.homography, *p).map(|q| q.to_array())).collect::<Option<_>>()?;
    let polygon = clipped(&outline, size);
    let quad = match <[[f64; 2]; 4]>::try_from(polygon.clone()) {
        Ok(quad) => quad,
        Err(polygon) => {
            let up = polygon.iter().map(|p| DVec2::new(p[0], -p[1])).collect();
            let along = DVec2::from(outline[1]) - DVec2::from(outline[0]);
            plane_rectangle(up, DVec2::new(along.x, -along.y).try_normalize()?)
                .map(|p| [p.x.clamp(0.0, size[0]), (-p.y).clamp(0.0, size[1])])
        }
    };
    let is_sound = [&polygon[..], &quad].iter().all(|p| text_labels::check_polygon(p).is_ok() && area(p) > 0.0);
    let (region, visibility) = (carried.region, carried.visibility);
    let ignore = visibility < READABLE || shortest_side(&quad) < READABLE_PX;
    (is_sound && visibility >= LEAST_VISIBLE).then(|| SetWord {
        id: region.id,
        quad,
        polygon,
        transcription: if ignore { UNREADABLE.into() } else { region.transcription.clone() },
        script: region.script.clone(),
        ignore,
        visibility,
        pose: None,
        cluster: None,
        characters: Vec::new(),
    })
}
