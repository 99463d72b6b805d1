//! `diorama bench tetrahedra`

use crate::commands::process::use_threads;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::bench::tetrahedra::{self, TetrahedraReport};
use std::path::PathBuf;

/// Compare the triangles of fitted tetrahedra and marching cubes at equal error: a sphere, and given meshes
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench tetrahedra spot.obj bob.obj")]
pub struct Tetrahedra {
    /// Closed meshes (.obj, .glb)
    meshes: Vec<PathBuf>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON array on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Tetrahedra {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let mut reports = Vec::new();
        let mut done = |r: TetrahedraReport| {
            if !self.json {
                print(&r);
            }
            reports.push(r);
        };
        done(tetrahedra::sphere());
        for file in &self.meshes {
            done(tetrahedra::mesh(file)?);
        }
        if self.json {
            println!("{}", serde_json::to_string(&reports).expect("plain values"));
        }
        Ok(Outcome::Done)
    }
}

fn print(r: &TetrahedraReport) {
    for (triangles, error) in &r.cubes {
        println!("{}: marching cubes: {triangles} triangles, mean error {error:.2e}", r.shape);
    }
    for c in &r.lattices {
        println!(
            "{}: lattice {}: {} triangles, {:.2e}: {:.2} of marching cubes'; fitted in {:.0} s: {} triangles, {:.2e}: {:.2}",
            r.shape, c.lattice, c.triangles, c.error, c.ratio, c.seconds, c.fitted_triangles, c.fitted_error, c.fitted_ratio
        );
    }
}
