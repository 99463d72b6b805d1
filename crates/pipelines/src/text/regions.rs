//! Text regions: rectangles on boards, their polygons and poses in views, and how much of them a view shows.

use diorama_geom::glam::{DMat3, DVec2, DVec3, dvec2};
use diorama_geom::{Camera, Pose};
use diorama_kernels::ops::path_trace::{Scene, cpu};
use diorama_scenes::signs::Board;
use serde::{Deserialize, Serialize};

/// Points along the upper and lower edge of a region that bends, besides its corners.
const BENT_POINTS: usize = 8;
/// Grid of a region whose points are visible or not: along the reading direction, and up.
pub const GRID: [usize; 2] = [32, 8];
/// How far before a surface light is followed to, in meters, so that the surface does not hide itself.
const BEFORE: f64 = 0.004;

/// A rectangle in board coordinates (meters from the middle, x along the reading direction, y up).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rect {
    pub low: [f64; 2],
    pub high: [f64; 2],
}

/// A word on a board.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Region {
    /// The same in all views; classes are one more, as 0 is the background.
    pub id: usize,
    pub board: usize,
    pub transcription: String,
    /// Name of its script in Unicode.
    pub script: String,
    pub rect: Rect,
    pub characters: Vec<Character>,
}

/// A character of a word.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Character {
    pub text: String,
    pub rect: Rect,
}

/// Pose of a region: `x_in_camera = rotation · x_in_region + translation`, with x along the reading direction, y up and z toward the reader.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TextPose {
    pub rotation: DMat3,
    pub translation: DVec3,
}

impl Rect {
    pub fn size(&self) -> DVec2 {
        DVec2::from(self.high) - DVec2::from(self.low)
    }

    pub fn middle(&self) -> DVec2 {
        0.5 * (DVec2::from(self.high) + DVec2::from(self.low))
    }

    pub fn contains(&self, at: DVec2) -> bool {
        (self.low[0]..=self.high[0]).contains(&at.x) && (self.low[1]..=self.high[1]).contains(&at.y)
    }

    /// Corners from the upper left in reading order, clockwise.
    fn corners(&self) -> [DVec2; 4] {
        let ([x0, y0], [x1, y1]) = (self.low, self.high);
        [dvec2(x0, y1), dvec2(x1, y1), dvec2(x1, y0), dvec2(x0, y0)]
    }
}

/// Pixel coordinates of points of a board; none if one of them is behind the camera.
fn projected(board: &Board, points: impl Iterator<Item = DVec2>, camera: &Camera, pose: &Pose) -> Option<Vec<[f64; 2]>> {
    let camera_from_world = pose.inverse();
    points.map(|p| camera.project(camera_from_world.point(board.point(p))).map(|p| p.to_array())).collect()
}

/// The columns of a rectangle that face a camera; none where it turns its back.
fn facing(board: &Board, rect: &Rect, pose: &Pose) -> Option<Rect> {
    let [low, high] = board.facing(pose.translation)?;
    let (low, high) = (low.max(rect.low[0]), high.min(rect.high[0]));
    (low < high).then_some(Rect { low: [low, rect.low[1]], high: [high, rect.high[1]] })
}

/// Corners in a view of what of a rectangle faces the camera, clockwise from the upper left in reading order; none behind the camera.
pub fn quad(board: &Board, rect: &Rect, camera: &Camera, pose: &Pose) -> Option<[[f64; 2]; 4]> {
    let corners = facing(board, rect, pose)?.corners();
    projected(board, corners.into_iter(), camera, pose).map(|points| std::array::from_fn(|k| points[k]))
}

/// Outline of the same from the same corner: the corners, or more points where the board bends.
pub fn polygon(board: &Board, rect: &Rect, camera: &Camera, pose: &Pose) -> Option<Vec<[f64; 2]>> {
    let [a, b, c, d] = facing(board, rect, pose)?.corners();
    if board.radius.is_none() {
        return projected(board, [a, b, c, d].into_iter(), camera, pose);
    }
    let along = |from: DVec2, to: DVec2| (0..=BENT_POINTS + 1).map(move |k| from.lerp(to, k as f64 / (BENT_POINTS + 1) as f64));
    projected(board, along(a, b).chain(along(c, d)), camera, pose)
}

/// Pose of a rectangle in a camera.
pub fn text_pose(board: &Board, rect: &Rect, pose: &Pose) -> TextPose {
    let camera_from_world = pose.inverse();
    let middle = rect.middle();
    TextPose {
        rotation: camera_from_world.rotation * board.world_from_face(middle.x),
        translation: camera_from_world.point(board.point(middle)),
    }
}

/// Share of a rectangle's grid of [`GRID`] points that is in the picture, faces the camera and has nothing before it.
pub fn visibility(scene: &Scene, board: &Board, rect: &Rect, camera: &Camera, pose: &Pose) -> f64 {
    let (eye, camera_from_world) = (pose.translation, pose.inverse());
    let [columns, rows] = GRID;
    let at = |i: usize| {
        let share = dvec2((i % columns) as f64 + 0.5, (i / columns) as f64 + 0.5) / dvec2(columns as f64, rows as f64);
        DVec2::from(rect.low) + share * rect.size()
    };
    let is_visible = |at: DVec2| {
        let point = board.point(at);
        let toward = (eye - point).normalize();
        let faces = board.world_from_face(at.x).z_axis.dot(toward) > 0.0;
        faces && camera.shows(camera_from_world.point(point)) && !cpu::is_between(scene, eye, point + BEFORE * toward)
    };
    (0..columns * rows).filter(|i| is_visible(at(*i))).count() as f64 / (columns * rows) as f64
}

/// What of a polygon is in a picture (Sutherland and Hodgman 1974), from the first corner that is, in the same order.
pub fn clipped(polygon: &[[f64; 2]], size: [f64; 2]) -> Vec<[f64; 2]> {
    let mut out = polygon.to_vec();
    for (axis, at, sign) in [(0, 0.0, 1.0), (0, size[0], -1.0), (1, 0.0, 1.0), (1, size[1], -1.0)] {
        let depth = |p: [f64; 2]| sign * (p[axis] - at);
        let mut next = Vec::new();
        for k in 0..out.len() {
            let (a, b) = (out[k], out[(k + 1) % out.len()]);
            if depth(a) >= 0.0 {
                next.push(a);
            }
            if (depth(a) >= 0.0) != (depth(b) >= 0.0) {
                let share = depth(a) / (depth(a) - depth(b));
                let mut crossing = [0, 1].map(|k| a[k] + share * (b[k] - a[k]));
                crossing[axis] = at;
                next.push(crossing);
            }
        }
        out = next;
    }
    out
}

/// Length of the shortest side of a quadrilateral.
pub fn shortest_side(quad: &[[f64; 2]; 4]) -> f64 {
    let side = |k: usize| DVec2::from(quad[k]).distance(DVec2::from(quad[(k + 1) % 4]));
    (0..4).map(side).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests;
