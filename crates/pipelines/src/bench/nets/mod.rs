//! `diorama bench nets`: layers and whole networks on the CPU, forward and training. `benches/peers/nets_torch.py` runs the same in PyTorch.

mod layers;
mod networks;

use crate::error::{PipelineError, Result};
use diorama_kernels::gemm::Precision;
use serde::Serialize;
use std::time::Instant;

/// Measurements, and the machine's own limit.
#[derive(Clone, Debug, Serialize)]
pub struct NetsReport {
    pub threads: usize,
    /// Measured multiply-adds of one core, in GFLOP/s.
    pub peak_gflops: f64,
    pub layers: Vec<LayerFigures>,
    pub networks: Vec<NetworkFigures>,
}

/// A layer: forward alone, and a forward and backward pass together, in GFLOP/s per core. Backward counts as two forward passes.
#[derive(Clone, Debug, Serialize)]
pub struct LayerFigures {
    pub name: &'static str,
    pub batch: usize,
    pub forward_gflops: f64,
    pub train_gflops: f64,
    #[serde(skip)]
    pub forward_ms: f64,
    #[serde(skip)]
    pub train_ms: f64,
}

/// A network: a forward pass without gradients, and a step of training with Adam.
#[derive(Clone, Debug, Serialize)]
pub struct NetworkFigures {
    pub name: &'static str,
    pub forward_ms: f64,
    pub train_ms: f64,
    /// Most memory of the process during both; none where the system does not tell. A network alone in a process is what compares.
    pub peak_bytes: Option<u64>,
    /// GFLOP/s per core; backward counts as two forward passes.
    #[serde(skip)]
    pub forward_gflops: f64,
    #[serde(skip)]
    pub train_gflops: f64,
}

/// A figure as soon as it is there.
pub enum Figures<'a> {
    Layer(&'a LayerFigures),
    Network(&'a NetworkFigures),
}

/// What is measured.
pub struct Wanted {
    /// Parts of names, as `name_batch` for layers; all where there are none.
    pub names: Vec<String>,
    /// Arithmetic of convolutions and fully connected layers.
    pub precision: Precision,
    /// Fewest calls per figure; the median counts.
    pub repeats: usize,
    /// Calls go on for so long.
    pub seconds: f64,
}

impl Wanted {
    fn has(&self, name: &str) -> bool {
        self.names.is_empty() || self.names.iter().any(|n| name.contains(&n[..]))
    }

    /// Median seconds of a call, after one that does not count.
    fn median<E>(&self, mut call: impl FnMut() -> std::result::Result<(), E>) -> std::result::Result<f64, E> {
        call()?;
        let (begin, mut times) = (Instant::now(), Vec::new());
        while times.len() < self.repeats.max(1) || begin.elapsed().as_secs_f64() < self.seconds {
            let start = Instant::now();
            call()?;
            times.push(start.elapsed().as_secs_f64());
        }
        times.sort_by(f64::total_cmp);
        Ok(times[times.len() / 2])
    }
}

/// Measures on `threads` of this process' pool, which has as many.
///
/// # Errors
/// When no layer and no network has one of the names.
pub fn run(wanted: &Wanted, each: &mut dyn FnMut(Figures)) -> Result<NetsReport> {
    let threads = rayon::current_num_threads();
    let peak_gflops = super::ops::fma_gflops();
    let mut report = NetsReport { threads, peak_gflops, layers: Vec::new(), networks: Vec::new() };
    for layer in layers::ALL.iter().filter(|l| wanted.has(&l.label())) {
        report.layers.push(layer.measure(wanted, threads));
        report.layers.last().into_iter().for_each(|l| each(Figures::Layer(l)));
    }
    for network in networks::ALL.iter().filter(|n| wanted.has(n.name)) {
        report.networks.push(network.measure(wanted, threads)?);
        report.networks.last().into_iter().for_each(|n| each(Figures::Network(n)));
    }
    if report.layers.is_empty() && report.networks.is_empty() {
        let known = layers::ALL.iter().map(layers::Layer::label).chain(networks::ALL.iter().map(|n| n.name.to_string()));
        let known = known.collect::<Vec<_>>().join(", ");
        return Err(PipelineError::Usage(format!("no layer and no network is called {}; there are {known}", wanted.names.join(" or "))));
    }
    Ok(report)
}
