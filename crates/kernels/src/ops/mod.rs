//! One folder per op.

pub mod activation;
pub mod adam;

pub mod antialias;
pub mod attention;
pub mod composite;
pub mod conv2d;
pub mod conv_transpose2d;
pub mod cube_prefilter;
pub mod denoise;
pub mod density_gradient;
pub mod depth_loss;
pub mod distortion;
pub mod dropout;
pub mod embedding;
pub mod error_map;
pub mod field_step;
pub mod frequency;
pub mod fused_mlp;
pub mod grid_sample;
pub mod hash_grid;

pub mod interpolate;
pub mod linear;
pub mod march;
pub mod marching_cubes;
pub mod marching_tetrahedra;
pub mod matmul;
pub mod mean_error;
pub mod mesh_smoothness;
pub mod norm;
pub mod occupancy_update;
pub mod path_trace;
pub mod photometric_loss;
pub mod pixel_draw;
pub mod pixel_gather;
pub mod pool;
pub mod prune;
pub mod rasterize;
pub mod ray_aabb;
pub mod ray_generation;
pub mod ray_triangles;
pub mod resample;
pub mod s3im;
pub mod sample_pdf;
pub mod scan;
pub mod sign_change_loss;
pub mod softmax;
pub mod spherical_harmonics;
pub mod split_sum;
pub mod ssim;
pub mod strata;
pub mod sum;

pub mod tetrahedral_surface;
pub mod texture;
pub mod triangle_wave;
pub mod trilinear_corner_grid;
pub mod vertex_normals;
pub mod weight_step;

#[cfg(test)]
mod torch_cases;
