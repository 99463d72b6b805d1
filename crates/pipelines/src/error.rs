//! Errors of applications.

use diorama_data::DataError;

pub type Result<T> = std::result::Result<T, PipelineError>;

/// A failure and whose fault it is.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    #[error(transparent)]
    Data(#[from] DataError),
    /// The request cannot be met as it stands (exit code 2).
    #[error("{0}")]
    Usage(String),
    /// The loss or a parameter was not finite at step `first`, and again at step `again`.
    #[error(
        "the loss was not finite at step {first}, and again at step {again} after going back and lowering the rate: stopped; {kept}; lower --set optim.rate"
    )]
    Diverged {
        first: u64,
        again: u64,
        /// Description of what is left of the run.
        kept: String,
    },
    /// The machine or a device has no room for the work: needs, has, cure.
    #[error("{0}")]
    Memory(String),
    /// A device failed or computed wrongly.
    #[error("{0}")]
    Device(String),
    /// A network refused its input.
    #[error(transparent)]
    Network(#[from] diorama_nets::OpError),
}

impl PipelineError {
    /// Whether the input or request is at fault.
    pub fn is_input(&self) -> bool {
        match self {
            PipelineError::Data(e) => e.is_input(),
            PipelineError::Usage(_) => true,
            PipelineError::Diverged { .. } | PipelineError::Memory(_) | PipelineError::Device(_) | PipelineError::Network(_) => false,
        }
    }

    /// One word for scripts.
    pub fn kind(&self) -> &'static str {
        match self {
            PipelineError::Data(e) if e.is_input() => "input",
            PipelineError::Data(_) => "io",
            PipelineError::Usage(_) => "usage",
            PipelineError::Diverged { .. } => "diverged",
            PipelineError::Memory(_) => "memory",
            PipelineError::Device(_) => "device",
            PipelineError::Network(_) => "network",
        }
    }
}
