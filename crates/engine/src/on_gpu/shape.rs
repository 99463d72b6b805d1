//! Device-side description of a field: encoding, network, space and precision. Parameters are kept apart.

use crate::fields::{DirectionCode, Encoder as FieldEncoder, Field};
use crate::step::measure;
use diorama_geom::contraction as geom;
use diorama_kernels::gemm::Precision;
use diorama_kernels::gpu::{Buffer, Gpu, Rows};
use diorama_kernels::ops::field_step::gpu::{Arithmetic, GpuNet};
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::fused_mlp::gpu::columns;
use diorama_kernels::ops::hash_grid::gpu::GpuHashGrid;
use diorama_kernels::ops::march::Space;
use diorama_kernels::ops::photometric_loss::Measure;
use diorama_kernels::ops::trilinear_corner_grid::gpu::{GpuVoxels, keep_empty};
use diorama_kernels::ops::{frequency, spherical_harmonics, triangle_wave};

enum Encoder {
    Hash(GpuHashGrid),
    Frequency(Frequency),
    TriangleWave { bands: usize },
    VoxelCorners { voxels: GpuVoxels, features: usize },
}

/// Encoder, network and space of a field on the device; its parameters are passed to each call.
pub struct Shape {
    encoder: Encoder,
    directions: DirectionCode,
    /// Bands of the second encoding, which the network reads last.
    waves: Option<usize>,
    pub net: GpuNet,
    /// Space in which positions are encoded.
    pub space: Space,
    /// How a loss measures colors and distances.
    pub measure: Measure,
}

impl Shape {
    /// `moves`: gradients of positions will be computed.
    pub fn new(gpu: &Gpu, field: &Field, moves: bool) -> Self {
        let arithmetic = if field.net.mlp.precision == Precision::F32 { Arithmetic::Exact } else { Arithmetic::Best };
        let (encoder, per_level) = match &field.encoder {
            FieldEncoder::Hash { grid, .. } => (Encoder::Hash(GpuHashGrid::new(gpu, grid)), grid.config.features),
            FieldEncoder::Frequency(f) => (Encoder::Frequency(*f), 0),
            FieldEncoder::TriangleWave { bands } => (Encoder::TriangleWave { bands: *bands }, 0),
            FieldEncoder::VoxelCorners { grid, .. } => {
                let voxels = GpuVoxels::upload(gpu, grid.resolution, grid.cells(), grid.rows());
                (Encoder::VoxelCorners { voxels, features: grid.features }, 0)
            }
        };
        // The features' where there is a table to be trained or positions move, and the appearance codes'; directions have none.
        let mut wanted = vec![field.encoder.table().is_some_and(|t| !t.frozen) || moves];
        wanted.extend((field.codes.direction.dims() > 0).then_some(false));
        wanted.extend(field.codes.appearance.as_ref().map(|a| !a.group.frozen).into_iter().chain(field.codes.given.iter().map(|_| true)));
        wanted.extend(field.waves.map(|_| moves));
        let space = match (field.encoder.is_centered(), field.space) {
            (false, geom::Space::Contracted(edge)) => Space::Contracted(edge),
            (false, geom::Space::Cube(edge)) => Space::Cube(edge),
            (true, geom::Space::Contracted(edge)) => Space::ContractedCentered(edge),
            (true, geom::Space::Cube(edge)) => Space::Centered(edge),
        };
        let net = GpuNet::new(gpu, &field.net, &field.density_net(Precision::F32), per_level, &wanted, arithmetic);
        Shape { encoder, directions: field.codes.direction, waves: field.waves, net, space, measure: measure(field) }
    }

    /// Encoded points `[S, 3]` of the field's space.
    ///
    /// # Panics
    /// When the encoder has a table and none is given.
    pub fn features(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, table: Option<&Buffer>) -> Buffer {
        let table = || table.expect("the encoder's table");
        match &self.encoder {
            Encoder::Hash(grid) => self.net.features(gpu, rows, grid.forward(gpu, rows, points, table())),
            Encoder::Frequency(f) => frequency::gpu::forward(gpu, f, points),
            Encoder::TriangleWave { bands } => triangle_wave::gpu::forward(gpu, *bands, points),
            Encoder::VoxelCorners { voxels, features } => {
                let (corners, local) = voxels.locate(gpu, rows, points);
                corners.forward(gpu, &local, table(), *features)
            }
        }
    }

    /// Triangle waves of points `[S, 3]`, where the network reads them.
    pub fn waves(&self, gpu: &Gpu, points: &Buffer) -> Option<Buffer> {
        self.waves.map(|bands| triangle_wave::gpu::forward(gpu, bands, points))
    }

    /// Adds the gradient of the points through the waves.
    pub fn waves_backward(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, d_waves: &Buffer, d_points: &Buffer) {
        if let Some(bands) = self.waves {
            let own = triangle_wave::gpu::backward(gpu, bands, points, d_waves);
            columns(gpu, rows, 3, (&own, 3, 0), (d_points, 3, 0), true);
        }
    }

    /// Gradient of the points.
    ///
    /// # Panics
    /// When the encoder has a table and none is given.
    pub fn points_backward(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, table: Option<&Buffer>, d_features: &Buffer) -> Buffer {
        let table = || table.expect("the encoder's table");
        match &self.encoder {
            Encoder::Hash(grid) => grid.backward_positions(gpu, rows, points, table(), d_features),
            Encoder::Frequency(f) => frequency::gpu::backward(gpu, f, points, d_features),
            Encoder::TriangleWave { bands } => triangle_wave::gpu::backward(gpu, *bands, points, d_features),
            Encoder::VoxelCorners { voxels, features } => {
                let (corners, local) = voxels.locate(gpu, rows, points);
                corners.places_backward(gpu, &local, table(), *features, d_features, voxels.edge())
            }
        }
    }

    /// Adds to the gradient of the table, where there is one.
    pub fn table_backward(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, d_features: &Buffer, d_table: &Buffer) {
        match &self.encoder {
            Encoder::Hash(grid) => grid.backward(gpu, rows, points, d_features, d_table),
            Encoder::VoxelCorners { voxels, features } => {
                let (corners, local) = voxels.locate(gpu, rows, points);
                corners.table_backward(gpu, &local, *features, d_features, d_table);
                keep_empty(gpu, *features, d_table);
            }
            Encoder::Frequency(_) | Encoder::TriangleWave { .. } => {}
        }
    }

    /// Codes of directions `[R, 3]`, where the network reads any.
    pub fn direction(&self, gpu: &Gpu, dirs: &Buffer) -> Option<Buffer> {
        match &self.directions {
            DirectionCode::None => None,
            DirectionCode::SphericalHarmonics(degree) => Some(spherical_harmonics::gpu::forward(gpu, *degree, dirs)),
            DirectionCode::Frequency(f) => Some(frequency::gpu::forward(gpu, f, dirs)),
        }
    }
}
