//! One folder per op.

pub mod adam;
pub mod composite;
pub mod conv2d;
pub mod conv_transpose2d;
pub mod depth_loss;
pub mod distortion;
pub mod frequency;
pub mod fused_mlp;
pub mod hash_grid;
pub mod linear;
pub mod march;
pub mod marching_cubes;
pub mod marching_tetrahedra;
pub mod matmul;
pub mod ngp_field;
pub mod pixel_gather;
pub mod ray_aabb;
pub mod ray_generation;
pub mod sample_pdf;
pub mod scan;
pub mod spherical_harmonics;
pub mod ssim;
pub mod triangle_wave;
pub mod trilinear_corner_grid;
