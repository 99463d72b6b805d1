//! Light that reaches a camera from triangles with materials: parts of the path tracer.

pub mod bsdf;
