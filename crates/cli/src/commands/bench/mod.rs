//! `diorama bench`: a group of commands.

mod check;
mod mesh;
mod nets;
mod ops;
mod path_trace;
mod raster;
mod reduce;
mod render;
mod tetrahedra;
mod thesis;
mod train;

use super::Verb;
use clap::Subcommand;

/// Measure the kernels and the training step on this machine
#[derive(Subcommand)]
pub enum Bench {
    Ops(ops::Ops),
    Train(train::Train),
    Render(render::Render),
    Mesh(mesh::Mesh),
    Reduce(reduce::Reduce),
    Tetrahedra(tetrahedra::Tetrahedra),
    Thesis(thesis::Thesis),
    Nets(nets::Nets),
    PathTrace(path_trace::PathTrace),
    Raster(raster::RasterBench),
    Check(check::Check),
}

impl Bench {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Bench::Ops(v) => v,
            Bench::Train(v) => v,
            Bench::Render(v) => v,
            Bench::Mesh(v) => v,
            Bench::Reduce(v) => v,
            Bench::Tetrahedra(v) => v,
            Bench::Thesis(v) => v,
            Bench::Nets(v) => v,
            Bench::PathTrace(v) => v,
            Bench::Raster(v) => v,
            Bench::Check(v) => v,
        }
    }
}
