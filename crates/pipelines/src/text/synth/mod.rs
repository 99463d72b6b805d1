//! Data sets of images of trained scenes with labelled writing, from cameras of wanted text poses.
//!
//! [`sampling`] draws cameras by clusters of text poses, which [`validity`] checks; [`image`] draws views with edits and labels; [`dataset`]
//! writes them.

pub mod dataset;
pub mod image;
pub mod merging;
pub mod plan;
pub mod prior;
pub mod sampling;
pub mod scene;
pub mod validity;
mod verification;
