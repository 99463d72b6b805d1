//! All numbers of a training run in one list, as a checkpoint holds them.

use super::{Ema, Optimizer, StateError};
use crate::param::{self, Module};
use crate::weights::{self, KeyMap, Mismatch, Strictness};
use diorama_geom::NamedArray;

/// Why a run cannot go on from what was saved.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ResumeError {
    #[error(transparent)]
    Weights(#[from] Mismatch),
    #[error(transparent)]
    State(#[from] StateError),
}

/// Weights, statistics, the optimizer's state, and the average where there is one: all that [`resume`] needs.
pub fn saved(module: &dyn Module, optimizer: &Optimizer, average: Option<&Ema>) -> Vec<NamedArray> {
    let average = average.map(Ema::state).unwrap_or_default();
    param::arrays(module).into_iter().chain(optimizer.state()).chain(average).collect()
}

/// Takes a saved run over; on the CPU it goes on as if it had never stopped, bit by bit. A [`super::Loader`] goes on from the batch
/// of [`Optimizer::steps`], where each step takes one.
///
/// # Errors
/// When an array is missing or does not fit; the run is as it was before then.
pub fn resume(module: &dyn Module, optimizer: &mut Optimizer, average: Option<&mut Ema>, arrays: &[NamedArray]) -> Result<(), ResumeError> {
    let before = param::arrays(module);
    weights::load(module, arrays, &KeyMap::PLAIN, Strictness::AllowUnexpected)?;
    let steps = optimizer.state();
    let restored = optimizer.restore(module, arrays).and_then(|()| average.map_or(Ok(()), |a| a.restore(arrays)));
    restored.map_err(|e| {
        weights::load(module, &before, &KeyMap::PLAIN, Strictness::Exact).expect("the network's own numbers fit it");
        optimizer.restore(module, &steps).expect("the optimizer's own state fits it");
        e.into()
    })
}
