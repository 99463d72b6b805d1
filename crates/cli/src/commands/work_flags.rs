//! Options of the commands that prepare data sets.

use clap::Args;

/// How a data set is prepared, whatever it is.
#[derive(Args, Clone, Debug)]
pub struct WorkFlags {
    /// Number of CPU threads [default: all]
    #[arg(long)]
    pub threads: Option<usize>,
    /// Continue where an interrupted call stopped
    #[arg(long)]
    pub resume: bool,
    /// Replace an earlier data set
    #[arg(long, conflicts_with = "resume")]
    pub force: bool,
    /// Print one JSON object on stdout
    #[arg(long)]
    pub json: bool,
}
