//! What a field is on the device besides its parameters.

use crate::fields::{DirectionCode, Encoder as FieldEncoder, Field};
use crate::step::relative;
use diorama_geom::contraction as geom;
use diorama_kernels::gemm::Precision;
use diorama_kernels::gpu::{Buffer, Gpu, Rows};
use diorama_kernels::ops::field_step::gpu::{Arithmetic, GpuNet};
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::hash_grid::gpu::GpuHashGrid;
use diorama_kernels::ops::march::gpu::Space;
use diorama_kernels::ops::{frequency, spherical_harmonics};

enum Encoder {
    Hash(GpuHashGrid),
    Frequency(Frequency),
}

/// A field's shape on the device.
pub struct Shape {
    encoder: Encoder,
    directions: DirectionCode,
    pub net: GpuNet,
    /// In which positions are encoded.
    pub space: Space,
    /// Whether space has no bound.
    pub is_unbounded: bool,
    /// What differences of linear light are divided by besides the prediction; else 0.
    pub relative: f32,
}

impl Shape {
    /// `moves` says whether gradients of positions will be asked for.
    pub fn new(gpu: &Gpu, field: &Field, moves: bool) -> Self {
        let arithmetic = if field.net.mlp.precision == Precision::F32 { Arithmetic::Exact } else { Arithmetic::Best };
        let (encoder, per_level) = match &field.encoder {
            FieldEncoder::Hash { grid, .. } => (Encoder::Hash(GpuHashGrid::new(gpu, grid)), grid.config.features),
            FieldEncoder::Frequency(f) => (Encoder::Frequency(*f), 0),
            other => panic!("no GPU encodes positions by {other:?}"),
        };
        // The features' where there is a table or positions move, and the appearance codes'; directions have none.
        let mut wanted = vec![per_level > 0 || moves];
        wanted.extend((field.codes.direction.dims() > 0).then_some(false));
        wanted.extend(field.codes.appearance.as_ref().map(|_| true).into_iter().chain(field.codes.given.iter().map(|_| true)));
        let space = match (&encoder, field.space) {
            (Encoder::Hash(_), geom::Space::Contracted(edge)) => Space::Contracted(edge),
            (Encoder::Hash(_), geom::Space::Cube(edge)) => Space::Cube(edge),
            (Encoder::Frequency(_), geom::Space::Contracted(edge)) => Space::ContractedCentred(edge),
            (Encoder::Frequency(_), geom::Space::Cube(edge)) => Space::Centred(edge),
        };
        let net = GpuNet::new(gpu, &field.net, &field.density_net(Precision::F32), per_level, &wanted, arithmetic);
        let is_unbounded = field.is_unbounded();
        Shape { encoder, directions: field.codes.direction, net, space, is_unbounded, relative: relative(field) }
    }

    /// Encoded points `[S, 3]` of the field's space; a hash grid reads its table.
    pub fn features(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, table: Option<&Buffer>) -> Buffer {
        match (&self.encoder, table) {
            (Encoder::Hash(grid), Some(table)) => self.net.features(gpu, rows, grid.forward(gpu, rows, points, table)),
            (Encoder::Frequency(f), _) => frequency::gpu::forward(gpu, f, points),
            (Encoder::Hash(_), None) => unreachable!("a hash field has a table"),
        }
    }

    /// Gradient of the points.
    pub fn points_backward(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, table: Option<&Buffer>, d_features: &Buffer) -> Buffer {
        match (&self.encoder, table) {
            (Encoder::Hash(grid), Some(table)) => grid.backward_positions(gpu, rows, points, table, d_features),
            (Encoder::Frequency(f), _) => frequency::gpu::backward(gpu, f, points, d_features),
            (Encoder::Hash(_), None) => unreachable!("a hash field has a table"),
        }
    }

    /// Adds to the gradient of the table, where there is one.
    pub fn table_backward(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, d_features: &Buffer, d_table: &Buffer) {
        if let Encoder::Hash(grid) = &self.encoder {
            grid.backward(gpu, rows, points, d_features, d_table);
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
