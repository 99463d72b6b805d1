//! Transforms of nodes, and the change of the axis that points up.

use super::document::Document;
use super::schema::Node;
use crate::error::Result;
use diorama_geom::glam::{DAffine3, DMat3, DMat4, DQuat, DVec3, DVec4};

/// Rotation to a world whose z points up from one whose y does.
pub const Z_UP_FROM_Y_UP: DMat3 = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::new(0.0, -1.0, 0.0));

/// A transform of a world whose z points up, from the same one with y up.
pub fn z_up(transform: DAffine3) -> DAffine3 {
    let turn = DAffine3::from_mat3(Z_UP_FROM_Y_UP);
    turn * transform * DAffine3::from_mat3(Z_UP_FROM_Y_UP.transpose())
}

/// A transform of a world whose y points up, from the same one with z up.
pub fn y_up(transform: DAffine3) -> DAffine3 {
    let turn = DAffine3::from_mat3(Z_UP_FROM_Y_UP.transpose());
    turn * transform * DAffine3::from_mat3(Z_UP_FROM_Y_UP)
}

/// `parent_from_node`, y up.
///
/// # Errors
/// If a rotation has no length or a number is not finite.
pub fn of(document: &Document, node: &Node, what: &str) -> Result<DAffine3> {
    let transform = match &node.matrix {
        Some(m) => {
            let m = DMat4::from_cols_array(m);
            let [x, y, z, t] = [0, 1, 2, 3].map(|i| m.col(i)).map(DVec4::truncate);
            DAffine3 { matrix3: DMat3::from_cols(x, y, z), translation: t }
        }
        None => {
            let rotation = DVec4::from(node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
            let rotation =
                rotation.try_normalize().ok_or_else(|| document.wrong(format!("{what}: its rotation is no quaternion; export again")))?;
            let (scale, translation) = (node.scale.unwrap_or([1.0; 3]), node.translation.unwrap_or_default());
            DAffine3::from_scale_rotation_translation(scale.into(), DQuat::from_vec4(rotation), translation.into())
        }
    };
    if !transform.is_finite() {
        return Err(document.wrong(format!("{what}: its transform is not finite; export again")));
    }
    Ok(transform)
}
