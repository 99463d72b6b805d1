//! A region's rectangle in the world: from its points a surface, and on it the smallest rectangle, or the rectangle of its labels.

use super::super::field::model::TextModel;
use super::super::placed::PlacedRegion;
use super::super::regions::GRID;
use super::super::surface::{self, Rectangle, Surface, Wanted};
use super::in_view::{self, OnSurface};
use super::points::{Cloud, ViewCache};
use diorama_data::text_labels::LabelledRegion;
use diorama_geom::capture::Frame;
use diorama_geom::glam::{DVec2, DVec3};

/// Views that a region needs.
const LEAST_VIEWS: usize = 2;
/// Deviation of the points from the surface, over the rectangle's height, from which they are on none.
const MOST_RESIDUAL: f64 = 0.05;
/// Pixels from the photograph's border at which an outline may have been cut.
const BORDER_PX: f64 = 0.75;
/// Deviations of the fit before the surface that are its own at least, and shares of the distance that may be.
const DEVIATIONS: f64 = 2.0;
const FRONTS: [f64; 8] = [0.0, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.16];
/// Share of the most points that are seen at any of them with which one is enough.
const ENOUGH: f64 = 0.97;

/// What the rectangle's sides follow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Extent {
    /// The labels' outlines, carried to the surface; the points where these are cut by the border.
    #[default]
    Labels,
    /// The smallest rectangle of the central 99 % of the points.
    Points,
}

/// How regions are fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FitOptions {
    pub surface: Wanted,
    pub extent: Extent,
}

/// A labelled outline of a region and the frame that shows it.
type Outline<'a> = (&'a Frame, &'a LabelledRegion);

/// Fits a region of a class; the note says what went wrong.
pub fn fit(model: &TextModel, class: u8, options: FitOptions, cache: &mut ViewCache) -> (PlacedRegion, Option<String>) {
    let known = &model.labels.classes[class as usize - 1];
    let outlines: Vec<Outline> = model
        .train
        .iter()
        .filter_map(|i| Some((&model.capture.frames[*i], model.labels.of_frame[*i].as_ref()?)))
        .flat_map(|(frame, image)| image.regions.iter().filter(|r| r.id == known.id).map(move |r| (frame, r)))
        .collect();
    let cloud = cache.cloud(class);
    let first = outlines.iter().map(|o| o.1).find(|r| !r.ignore);
    let mut out = PlacedRegion {
        id: known.id,
        transcription: known.transcription.clone(),
        script: first.and_then(|r| r.script.clone()),
        kind: first.map(|r| r.kind).unwrap_or_default(),
        rectangle: None,
        points: cloud.points.len(),
        front: 0.0,
    };
    let note = match rectangle(&cloud, &outlines, options) {
        Ok(r) => {
            out.rectangle = Some(r);
            out.front = front(model, &out, &outlines);
            None
        }
        Err(why) => Some(format!("region {} ({:?}): {why}", known.id, known.transcription)),
    };
    (out, note)
}

/// The rectangle of a cloud.
fn rectangle(cloud: &Cloud, outlines: &[Outline], options: FitOptions) -> Result<Rectangle, String> {
    let n = cloud.points.len();
    if cloud.views < LEAST_VIEWS || n < surface::LEAST_POINTS {
        let least = surface::LEAST_POINTS;
        let have = format!("{n} points in {} views, of which {least} in {LEAST_VIEWS} are needed", cloud.views);
        return Err(format!("{have}; label a photograph that shows it larger"));
    }
    let (points, spacing) = surface::cleaned(&cloud.points);
    let points = surface::smoothed(&points, spacing);
    let mean = points.iter().sum::<DVec3>() / points.len().max(1) as f64;
    let fitted = surface::fit(&points, cloud.eye - mean, options.surface).map_err(|e| e.to_string())?;
    let carried: Vec<(bool, Vec<DVec2>)> = outlines.iter().filter_map(|o| Some((is_whole(o), carried(&fitted, o)?))).collect();
    let whole: Vec<Vec<DVec2>> = carried.iter().filter(|c| c.0).map(|c| c.1.clone()).collect();
    let by_labels = surface::outlined(&fitted, &whole);
    let reading = carried.first().map(|(_, outline)| {
        let half = outline.len() / 2;
        fitted.point(outline[half - 1]) - fitted.point(outline[0])
    });
    let by_points = || surface::rectangle(&fitted, &points, reading, DVec3::Z);
    let out = match (options.extent, by_labels) {
        (Extent::Labels, Some(r)) => r,
        _ => by_points(),
    };
    let share = fitted.rms / out.reading_size().y;
    // Photographs do not tell depth more finely than their pixels.
    if share > MOST_RESIDUAL && fitted.rms > pixel(&out, outlines) {
        let percent = 100.0 * share;
        return Err(format!("not a surface: its points deviate by {percent:.0} % of its height; its polygons are kept view by view"));
    }
    Ok(out)
}

/// Length on a rectangle of a pixel of the nearest labelled photograph.
fn pixel(rectangle: &Rectangle, outlines: &[Outline]) -> f64 {
    let middle = rectangle.reading_point(DVec2::ZERO);
    let of = |(frame, _): &Outline| frame.world_from_camera.translation.distance(middle) / frame.camera.fx;
    outlines.iter().map(of).fold(f64::INFINITY, f64::min)
}

/// Distance before a region's surface from which on matter is the surface's own: the least at which photographs whose labels say that it can
/// be read see it.
fn front(model: &TextModel, region: &PlacedRegion, outlines: &[Outline]) -> f64 {
    let Some(word) = OnSurface::of(region) else { return 0.0 };
    let least = DEVIATIONS * word.rectangle.surface.rms;
    let frames: Vec<&Frame> = outlines.iter().filter(|(_, r)| !r.ignore).map(|(frame, _)| *frame).collect();
    let seen = |share: f64| {
        let (mut n, mut of) = (0, 0);
        for frame in &frames {
            let (eye, camera_from_world) = (frame.world_from_camera.translation, frame.world_from_camera.inverse());
            let points = (0..GRID[0] * GRID[1]).map(|i| word.rectangle.reading_point(word.grid_point(i)));
            let points: Vec<DVec3> = points.filter(|p| frame.camera.shows(camera_from_world.point(*p))).collect();
            let front = (share * eye.distance(word.rectangle.reading_point(DVec2::ZERO))).max(least);
            let light = in_view::transmittance(model, eye, &points, front);
            (n, of) = (n + light.iter().filter(|l| **l > 0.5).count(), of + light.len());
        }
        n as f64 / of.max(1) as f64
    };
    let shares: Vec<f64> = FRONTS.iter().map(|f| seen(*f)).collect();
    let most = shares.iter().copied().fold(0.0, f64::max);
    let k = shares.iter().position(|s| *s >= ENOUGH * most).unwrap_or(0);
    let mean = frames.iter().map(|f| f.world_from_camera.translation.distance(word.rectangle.reading_point(DVec2::ZERO))).sum::<f64>();
    (FRONTS[k] * mean / frames.len().max(1) as f64).max(least)
}

/// Whether an outline is not cut by the photograph's border.
fn is_whole((frame, region): &Outline) -> bool {
    let (w, h) = (frame.camera.width as f64, frame.camera.height as f64);
    region.polygon.iter().all(|[x, y]| x.min(*y) > BORDER_PX && w - x > BORDER_PX && h - y > BORDER_PX)
}

/// An outline on a surface, as points of its plane; none where a ray passes it by.
fn carried(surface: &Surface, (frame, region): &Outline) -> Option<Vec<DVec2>> {
    let pose = &frame.world_from_camera;
    let at = |p: &[f64; 2]| {
        let direction = pose.rotation * frame.camera.direction(p[0], p[1]).normalize();
        surface.hits(pose.translation, direction).into_iter().flatten().next().map(|(_, place)| place)
    };
    region.polygon.iter().map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_data::text_labels::Kind;
    use diorama_geom::glam::DMat3;
    use diorama_geom::rng::Rng;
    use diorama_geom::{Camera, Pose};

    /// A board of 0.8 × 0.2 that waves by `height`, and a photograph of it from 2 before it, with its outline.
    fn board(height: f64) -> (Cloud, Frame, LabelledRegion) {
        let rng = Rng::new(4, 0);
        let u = |k: u64| rng.uniform(k) as f64 - 0.5;
        let at = |k: u64| DVec3::new(0.8 * u(2 * k), 0.2 * u(2 * k + 1), 0.0);
        let points = (0..3000).map(at).map(|p| p + DVec3::Z * height * (12.0 * p.x).sin()).collect();
        let eye = DVec3::new(0.0, 0.0, 2.0);
        let pose = Pose { rotation: DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), translation: eye };
        let camera = Camera::pinhole(640, 480, 0.8);
        let corner = |[x, y]: [f64; 2]| camera.project(pose.inverse().point(DVec3::new(x, y, 0.0))).unwrap().to_array();
        let region = LabelledRegion {
            id: 3,
            polygon: [[-0.4, 0.1], [0.4, 0.1], [0.4, -0.1], [-0.4, -0.1]].map(corner).to_vec(),
            transcription: "CAFE".into(),
            script: None,
            kind: Kind::Text,
            ignore: false,
        };
        (Cloud { points, views: 2, eye }, Frame::new("a", "a.png", camera, pose), region)
    }

    #[test]
    fn points_that_are_on_no_surface_and_too_few_of_them_are_told() {
        let (cloud, frame, region) = board(0.0);
        let fitted = rectangle(&cloud, &[(&frame, &region)], FitOptions::default()).unwrap();
        assert!((fitted.reading_size() - DVec2::new(0.8, 0.2)).length() < 0.01, "{:?}", fitted.reading_size());
        let one_view = Cloud { views: 1, ..cloud };
        let e = rectangle(&one_view, &[(&frame, &region)], FitOptions::default()).unwrap_err();
        assert!(e.contains("3000 points in 1 views, of which 50 in 2 are needed; label a photograph"), "{e}");
        let few = Cloud { points: one_view.points[..49].to_vec(), views: 2, eye: one_view.eye };
        let e = rectangle(&few, &[(&frame, &region)], FitOptions::default()).unwrap_err();
        assert!(e.contains("49 points in 2 views, of which 50 in 2"), "{e}");
        let (waving, frame, region) = board(0.06);
        let e = rectangle(&waving, &[(&frame, &region)], FitOptions::default()).unwrap_err();
        assert!(e.contains("not a surface: its points deviate by ") && e.contains("its polygons are kept view by view"), "{e}");
    }
}
