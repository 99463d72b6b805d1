//! Detectors of writing: EAST (Zhou et al. 2017) and DB (Liao et al. 2020), trained on labelled images and scored.
//!
//! [`targets`] makes maps of outlines, [`boxes`] reads them.

pub mod boxes;
pub mod det_eval;
pub mod evaluation;
pub mod polygon;
pub mod targets;
