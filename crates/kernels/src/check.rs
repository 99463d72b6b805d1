//! Compares every op on a device with its f64 reference, forward and backward, on the cases of `ops/<op>/cases.rs`.

use crate::device::Api;
use crate::gpu::{Gpu, GpuError};
use crate::ops::{
    adam, composite, depth_loss, distortion, error_map, field_step, frequency, fused_mlp, grid_sample, hash_grid, linear, march,
    marching_cubes, marching_tetrahedra, occupancy_update, path_trace, photometric_loss, pixel_draw, pixel_gather, pool, prune, ray_aabb,
    ray_generation, ray_triangles, resample, sample_pdf, scan, spherical_harmonics, ssim, strata, triangle_wave, trilinear_corner_grid,
};

use std::process::ExitCode;
use std::time::Instant;

pub use crate::gpu::table::{Row, TOLERANCE, Table};

/// Runs all cases.
///
/// # Errors
/// When the device is lost. A wrong result is no error but a row with a fault.
pub fn run(gpu: &Gpu) -> Result<Vec<Row>, GpuError> {
    let mut table = Table::new(gpu);
    let ops = [
        hash_grid::cases::check,
        frequency::cases::check,
        triangle_wave::cases::check,
        spherical_harmonics::cases::check,
        linear::cases::check,
        fused_mlp::cases::check,
        composite::cases::check,
        distortion::cases::check,
        depth_loss::cases::check,
        photometric_loss::cases::check,
        scan::cases::check,
        ray_aabb::cases::check,
        ray_triangles::cases::check,
        march::cases::check,
        occupancy_update::cases::check,
        sample_pdf::cases::check,
        strata::cases::check,
        trilinear_corner_grid::cases::check,
        pixel_gather::cases::check,
        error_map::cases::check,
        pixel_draw::cases::check,
        prune::cases::check,
        adam::cases::check,
        ray_generation::cases::check,
        ssim::cases::check,
        field_step::cases::check,
        marching_cubes::cases::check,
        marching_tetrahedra::check,
        resample::cases::check,
        pool::cases::check,
        grid_sample::cases::check,
        path_trace::cases::check,
    ];
    for check in ops {
        check(gpu, &mut table)?;
    }
    Ok(table.rows)
}

/// Main function of a program that runs cases on the device which its argument names, and prints what is wrong. Fails unless all results are
/// right; exits with 2 where the device cannot be opened, or the cases cannot run on it.
pub fn main(title: &str, cases: impl Fn(&Gpu) -> Result<Vec<Row>, String>) -> ExitCode {
    let Some(name) = std::env::args().nth(1) else {
        eprintln!("give the device to check, for example vulkan");
        return ExitCode::from(2);
    };
    let begin = Instant::now();
    let open = || Gpu::open(name.parse::<Api>()?).map_err(|e| e.to_string());
    let (gpu, rows) = match open().and_then(|gpu| cases(&gpu).map(|rows| (gpu, rows))) {
        Ok(done) => done,
        Err(e) => {
            eprintln!("device {name}: {e}");
            return ExitCode::from(2);
        }
    };
    for row in &rows {
        if let Some(fault) = &row.fault {
            println!("WRONG {} {} ({}): {fault}", row.op, row.result, row.shape);
        }
    }
    let right = rows.iter().filter(|r| r.fault.is_none()).count();
    println!("{right} of {} right in {title} on {name} ({}) in {:.0} s", rows.len(), gpu.name, begin.elapsed().as_secs_f64());
    if right == rows.len() && right > 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
