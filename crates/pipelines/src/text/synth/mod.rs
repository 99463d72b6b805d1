//! Data sets of images of trained scenes with labelled writing, from cameras of wanted text poses.
//!
//! [`sampling`] draws cameras by clusters of text poses, which [`validity`] checks; [`image`] draws views with edits and labels, whose look
//! [`appearance`] changes; [`dataset`] writes them.

pub mod appearance;
pub mod dataset;
pub mod image;
pub mod journal;
mod maker;
pub mod merging;
pub mod plan;
pub mod prior;
#[cfg(test)]
pub mod refusal_tests;
pub mod sampling;
pub mod scene;
#[cfg(test)]
pub mod styled_tests;
pub mod validity;
mod verification;
