//! Fields on a GPU. In training, parameters, photographs and occupancy stay there, and nothing is read back but
//! [`GpuTrainer::figures`] and, for a checkpoint, [`GpuTrainer::download`].

pub mod check;
mod place;
mod shape;
mod tracer;
mod trainer;

pub use tracer::GpuTracer;
pub use trainer::GpuTrainer;
