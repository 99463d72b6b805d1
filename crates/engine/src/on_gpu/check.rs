//! Views on a device against those that the CPU draws.

mod views;

use super::GpuTracer;
use crate::fields::{self, DensityQuery, FieldBuffers};
use crate::renderers::supervised::Supervised;
use crate::renderers::volume::{self, Accelerator, Quality, Tracer};
use crate::samplers::occupancy::Occupancy;
use crate::samplers::placement::Placement;
use diorama_geom::contraction;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Pose};
use diorama_kernels::check::{Row, Table};
use diorama_kernels::gpu::{Gpu, GpuError};
use diorama_kernels::ops::hash_grid::HashGridConfig;
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_testkit::{random_unit, wide};

/// Runs all cases.
///
/// # Errors
/// When the device is lost; wrong results are rows with a fault.
pub fn run(gpu: &Gpu) -> Result<Vec<Row>, GpuError> {
    let mut table = Table::new(gpu);
    for case in [views::views, views::other_views] {
        case(gpu, &mut table)?;
    }
    Ok(table.rows)
}
