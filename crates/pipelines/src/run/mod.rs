//! Everything that runs of all applications share: configuration, device, folder, capture, checkpoints, metrics, summary and viewing.
//! It imports no application.

pub mod config;
pub mod description;
pub mod device;
pub mod folder;
pub mod html;
pub mod kept_capture;
pub mod memory;
pub mod metrics;
pub mod nearest;
pub mod param_state;
pub mod perceptual;
pub mod photographs;
pub mod prepare;
pub mod profile;
pub mod sparse_points;
pub mod stages;
pub mod summary;
pub mod training;
pub mod undistort;
pub mod viewer_files;
pub mod viewing;
pub mod viewing_points;

pub use description::RunDescription;
pub use folder::RunFolder;
