//! Detectors of writing: EAST (Zhou et al. 2017) and DB (Liao et al. 2020), trained on labelled images and scored.

pub mod det_eval;
pub mod evaluation;
pub mod polygon;
