//! `diorama bench train`

use crate::error::Result;
use crate::object::config::Config;
use crate::object::recipe;
use crate::run::profile::TrainReport;

/// Trains `warmup` steps unmeasured, then `steps` steps measured, and writes nothing.
pub fn run(config: &Config, warmup: u64, steps: u64) -> Result<TrainReport> {
    recipe::profile(config, warmup, steps)
}
