//! Boards: flat or bent rectangles in board coordinates, in meters from the middle, x along the reading direction and y up.

use crate::assembly::{Assembly, Finish, ModelBuilder};
use diorama_geom::ImageU8;
use diorama_geom::glam::{DAffine3, DMat3, DVec2, DVec3, dvec2, dvec3};

/// Columns of the faces of a bent board.
const COLUMNS: usize = 48;
/// Roughness of painted boards: a mild gloss.
const ROUGHNESS: f32 = 0.4;

/// A surface with writing. `z` of its frame points toward the reader; where it bends, around an axis along `y` behind it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Board {
    /// Width along the surface, and height.
    pub size: DVec2,
    pub world_from_board: DAffine3,
    /// Radius of the bend; none: flat.
    pub radius: Option<f64>,
    /// Depth of the plate behind the face.
    pub thickness: f64,
}

impl Board {
    /// A flat board at a place; a reader in front of it looks along +y, turned about the vertical by `yaw`.
    pub(crate) fn flat(at: [f64; 3], yaw: f64, size: [f64; 2]) -> Board {
        let upright = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);
        let world_from_board = DAffine3::from_mat3_translation(DMat3::from_rotation_z(yaw) * upright, DVec3::from(at));
        Board { size: DVec2::from(size), world_from_board, radius: None, thickness: 0.03 }
    }

    /// The same, leaning back by an angle.
    pub(crate) fn leaning(self, angle: f64) -> Board {
        Board { world_from_board: self.world_from_board * DAffine3::from_rotation_x(-angle), ..self }
    }

    /// The same, turned in its plane.
    pub(crate) fn rolled(self, angle: f64) -> Board {
        Board { world_from_board: self.world_from_board * DAffine3::from_rotation_z(angle), ..self }
    }

    /// The same, bent.
    pub(crate) fn bent(self, radius: f64) -> Board {
        Board { radius: Some(radius), thickness: 0.004, ..self }
    }

    /// The same with a plate of another depth.
    pub(crate) fn thick(self, thickness: f64) -> Board {
        Board { thickness, ..self }
    }

    /// The world's point at board coordinates.
    pub fn point(&self, at: DVec2) -> DVec3 {
        self.world_from_board.transform_point3(self.in_frame(at, 0.0))
    }

    /// The point at board coordinates in the board's frame, so far behind the face.
    fn in_frame(&self, at: DVec2, behind: f64) -> DVec3 {
        match self.radius {
            None => dvec3(at.x, at.y, -behind),
            Some(r) => {
                let angle = at.x / r;
                dvec3((r - behind) * angle.sin(), at.y, (r - behind) * angle.cos() - r)
            }
        }
    }

    /// Board coordinates of a point of the world on the face.
    pub fn locate(&self, point_in_world: DVec3) -> DVec2 {
        let p = self.world_from_board.inverse().transform_point3(point_in_world);
        match self.radius {
            None => dvec2(p.x, p.y),
            Some(r) => dvec2(r * p.x.atan2(p.z + r), p.y),
        }
    }

    /// Orientation of the face at a column: x along the reading direction, y up, z toward the reader.
    pub fn world_from_face(&self, x: f64) -> DMat3 {
        let turn = self.radius.map_or(DMat3::IDENTITY, |r| DMat3::from_rotation_y(x / r));
        self.world_from_board.matrix3 * turn
    }

    /// Columns, from the lowest to the highest, whose face an eye sees; none where it sees none.
    pub fn facing(&self, eye_in_world: DVec3) -> Option<[f64; 2]> {
        let half = 0.5 * self.size.x;
        let eye = self.world_from_board.inverse().transform_point3(eye_in_world);
        let Some(r) = self.radius else { return (eye.z > 0.0).then_some([-half, half]) };
        // Seen from outside of a cylinder, up to the tangents.
        let (distance, at) = (eye.x.hypot(eye.z + r), eye.x.atan2(eye.z + r));
        let reach = (distance > r).then(|| (r / distance).acos())?;
        let [low, high] = [(r * (at - reach)).max(-half), (r * (at + reach)).min(half)];
        (low < high).then_some([low, high])
    }

    /// Adds the board with a picture on its face.
    pub(crate) fn stand(&self, builder: &mut ModelBuilder, k: usize, picture: &ImageU8, trim: Finish) {
        let finish = builder.pictured(&format!("board.{k}"), picture, ROUGHNESS);
        let columns = if self.radius.is_some() { COLUMNS } else { 1 };
        let half = 0.5 * self.size;
        let at = |i: usize, j: usize, behind: f64| {
            let share = dvec2(i as f64 / columns as f64, j as f64);
            (self.in_frame(-half + share * self.size, behind), dvec2(share.x, 1.0 - share.y))
        };
        let mut board = Assembly::default();
        board.piece("front", finish).grid(columns, 1, |i, j| at(i, j, 0.0));
        let plate = board.piece("plate", trim);
        let t = self.thickness;
        plate.grid(columns, 1, |i, j| at(columns - i, j, t));
        plate.grid(1, 1, |i, j| at(0, j, if i == 0 { t } else { 0.0 }));
        plate.grid(1, 1, |i, j| at(columns, j, if i == 0 { 0.0 } else { t }));
        plate.grid(columns, 1, |i, j| at(i, 1, if j == 0 { 0.0 } else { t }));
        plate.grid(columns, 1, |i, j| at(i, 0, if j == 0 { t } else { 0.0 }));
        builder.stand(&format!("board.{k}"), &board, &[self.world_from_board]);
    }
}
