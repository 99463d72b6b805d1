//! Rectangles in reading coordinates, which are lengths from the middle, x along the reading direction and y up; rays that meet them; and
//! rectangles from outlines.

use super::fit::{Kind, Surface};
use super::rectangle::{Rectangle, bends, lengths};
use diorama_geom::glam::{DMat3, DVec2, DVec3, dvec2};

/// Columns by which the part of a bent rectangle that faces an eye is found.
const COLUMNS: usize = 64;
/// Curvature along a ray, in units of its length, below which a surface is flat there.
const FLAT: f64 = 1e-12;

impl Rectangle {
    /// Width along the reading direction, and height.
    pub fn reading_size(&self) -> DVec2 {
        if self.quarter_turns.is_multiple_of(2) { self.size } else { dvec2(self.size.y, self.size.x) }
    }

    fn own(&self, at: DVec2) -> DVec2 {
        match self.quarter_turns % 4 {
            0 => at,
            1 => dvec2(-at.y, at.x),
            2 => -at,
            _ => dvec2(at.y, -at.x),
        }
    }

    fn read(&self, own: DVec2) -> DVec2 {
        match self.quarter_turns % 4 {
            0 => own,
            1 => dvec2(own.y, -own.x),
            2 => -own,
            _ => dvec2(-own.y, own.x),
        }
    }

    /// The world's point at reading coordinates.
    pub fn reading_point(&self, at: DVec2) -> DVec3 {
        self.point(self.own(at))
    }

    /// Frame at reading coordinates: x along the reading direction, y up, z the normal, toward the reader.
    pub fn reading_frame(&self, at: DVec2) -> DMat3 {
        let z = self.surface.normal(self.place(self.own(at)));
        let step = dvec2(1e-4 * self.size.x, 0.0);
        let x = self.reading_point(at + step) - self.reading_point(at - step);
        let x = (x - z * x.dot(z)).normalize();
        DMat3::from_cols(x, z.cross(x), z)
    }

    /// Corners from the upper left, clockwise in reading order.
    pub fn reading_corners(&self) -> [DVec2; 4] {
        let h = 0.5 * self.reading_size();
        [dvec2(-h.x, h.y), h, dvec2(h.x, -h.y), -h]
    }

    /// Where a ray first meets the rectangle, which may be widened by a margin: its distance in lengths of `direction`, and reading
    /// coordinates.
    pub fn hit(&self, origin: DVec3, direction: DVec3, margin: f64) -> Option<(f64, DVec2)> {
        let half = 0.5 * self.reading_size() + margin;
        self.surface.hits(origin, direction).into_iter().flatten().find_map(|(t, place)| {
            let at = self.read(self.locate(place));
            (at.abs().cmple(half).all()).then_some((t, at))
        })
    }

    /// The columns, from the lowest to the highest, that face an eye; none where it sees none.
    pub fn facing(&self, eye: DVec3) -> Option<[f64; 2]> {
        let half = 0.5 * self.reading_size().x;
        let faces = |x: f64| {
            let at = dvec2(x, 0.0);
            self.surface.normal(self.place(self.own(at))).dot(eye - self.reading_point(at)) > 0.0
        };
        if self.surface.kind == Kind::Plane {
            return faces(0.0).then_some([-half, half]);
        }
        let edge = |k: usize| half * (2.0 * k as f64 / COLUMNS as f64 - 1.0);
        let facing: Vec<usize> = (0..COLUMNS).filter(|k| faces(0.5 * (edge(*k) + edge(k + 1)))).collect();
        Some([edge(*facing.first()?), edge(facing.last()? + 1)])
    }
}

impl Surface {
    /// Distances along a ray at which it meets the whole surface from its front, nearest first, with the plane's points under them.
    pub fn hits(&self, origin: DVec3, direction: DVec3) -> [Option<(f64, DVec2)>; 2] {
        let (o, d) = (self.world_from_local.transpose() * (origin - self.origin), self.world_from_local.transpose() * direction);
        let [a, b, c, ..] = self.height;
        let (height, slope) = self.height_at(o.truncate());
        // The height along the ray is a polynomial of degree 2.
        let square = a * d.x * d.x + b * d.x * d.y + c * d.y * d.y;
        let linear = slope.dot(d.truncate()) - d.z;
        let constant = height - o.z;
        let roots = if square.abs() <= FLAT * linear.abs() {
            [(linear != 0.0).then(|| -constant / linear), None]
        } else {
            let root = (linear * linear - 4.0 * square * constant).max(-1.0);
            let root = if root < 0.0 { f64::NAN } else { root.sqrt() };
            let q = -0.5 * (linear + root.copysign(linear));
            let [x, y] = [q / square, constant / q];
            [Some(x.min(y)), Some(x.max(y))]
        };
        roots.map(|t| {
            let t = t.filter(|t| t.is_finite() && *t > 0.0)?;
            let place = (o + t * d).truncate();
            (self.normal(place).dot(direction) < 0.0).then_some((t, place))
        })
    }
}

/// The rectangle of outlines of one region, each clockwise from the upper left in reading order, as points of the surface's plane: its
/// direction and sides are their means. None without outlines of at least four points.
pub fn outlined(surface: &Surface, outlines: &[Vec<DVec2>]) -> Option<Rectangle> {
    let bends = bends(surface);
    let outlines: Vec<&Vec<DVec2>> = outlines.iter().filter(|o| o.len() >= 4).collect();
    let places = outlines.iter().flat_map(|o| o.iter());
    let from = places.clone().sum::<DVec2>() / places.count().max(1) as f64;
    let along: Vec<Vec<DVec2>> = outlines.iter().map(|o| o.iter().map(|p| lengths(surface, from, bends, *p)).collect()).collect();
    // The upper edge is the first half, the lower edge comes back.
    let direction = |o: &Vec<DVec2>| {
        let half = o.len() / 2;
        (o[half - 1] - o[0]) + (o[half] - o[o.len() - 1])
    };
    let x = along.iter().filter_map(|o| direction(o).try_normalize()).sum::<DVec2>().try_normalize()?;
    let y = dvec2(-x.y, x.x);
    let n = along.len() as f64;
    let mean = |of: &dyn Fn(&Vec<DVec2>) -> DVec2| along.iter().map(of).sum::<DVec2>() / n;
    let own = |p: DVec2| dvec2(p.dot(x), p.dot(y));
    let high = mean(&|o| {
        let half = o.len() / 2;
        let upper = o[..half].iter().map(|p| own(*p).y).sum::<f64>() / half as f64;
        dvec2(0.5 * (own(o[half - 1]).x + own(o[half]).x), upper)
    });
    let low = mean(&|o| {
        let half = o.len() / 2;
        let lower = o[half..].iter().map(|p| own(*p).y).sum::<f64>() / (o.len() - half) as f64;
        dvec2(0.5 * (own(o[0]).x + own(o[o.len() - 1]).x), lower)
    });
    (high.cmpgt(low).all()).then(|| Rectangle::reading_along(surface, from, x, [low, high]))
}
