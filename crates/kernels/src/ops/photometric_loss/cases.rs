//! Cases of the op, for its tests and for `bench check`.

use super::{ColorLoss, Measure, Photometric, Targets, Terms, reference};
use crate::ops::composite::cases::{Scene, scene};
use crate::ops::composite::{self, Composited};
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Buffer, Gpu, GpuError, table::Table},
    ops::composite::gpu::{GpuComposited, GpuPacked},
    ops::field_step::reference::near_share,
    ops::photometric_loss::gpu::{self as on_gpu, Figures, SUMS, Target},
};
use diorama_testkit::{random_unit, wide};

/// Closer to the camera than this, gradients are scaled, where they are.
#[cfg(feature = "gpu")]
const NEAR: f32 = 1.0;

/// Rays with the colors of their samples, and what they are compared with.
pub struct Case {
    pub terms: Terms,
    pub measure: Measure,
    pub scene: Scene,
    pub rgb: Vec<f32>,
    pub rgba: Vec<f32>,
    pub background: Vec<f32>,
    pub counts: Vec<bool>,
    /// 1 for rays that lost samples, which are among those that do not count.
    #[cfg(feature = "gpu")]
    pub cut: Vec<u32>,
    pub distance: Vec<f32>,
}

pub fn cases() -> Vec<Case> {
    let huber = ColorLoss::Huber(0.1);
    let kinds = [(ColorLoss::Mse, 0.0, true, 0.4), (huber, 0.0, false, 0.0), (huber, 0.05, false, 0.4)];
    let of = |(rays, (color, relative, normalized, depth)): (usize, (ColorLoss, f32, bool, f32))| {
        let scene = scene(rays, 3);
        Case {
            terms: Terms { color, distortion: 0.3, depth, alpha: 0.2 },
            measure: Measure { relative, normalized },
            rgb: random_unit(scene.t.len() * 3, 8),
            rgba: random_unit(rays * 4, 7),
            background: random_unit(rays * 3, 9),
            counts: (0..rays).map(|r| r % 9 != 2).collect(),
            #[cfg(feature = "gpu")]
            cut: (0..rays).map(|r| (r % 27 == 2) as u32).collect(),
            // Of every third ray.
            distance: random_unit(rays, 10).iter().zip(0..).map(|(u, r)| if r % 3 == 0 { 0.1 + 3.0 * u } else { 0.0 }).collect(),
            scene,
        }
    };
    [0, 1, 130, 700].into_iter().flat_map(|rays| kinds.map(|kind| (rays, kind))).map(of).collect()
}

/// The loss in f64.
pub struct Want {
    pub out: Composited<f64>,
    /// Loss and squared error of each ray.
    pub values: Vec<f64>,
    pub errors: Vec<f64>,
    pub d: Composited<f64>,
}

impl Case {
    pub fn loss(&self) -> Photometric<'_> {
        let targets = Targets { rgba: &self.rgba, background: &self.background, counts: &self.counts, distance: &self.distance };
        Photometric::new(self.terms, self.measure, targets, self.scene.packed())
    }

    pub fn want(&self) -> Want {
        let (p, loss) = (self.scene.packed(), self.loss());
        let out = composite::reference::forward(&p, &wide(&self.scene.sigma), &wide(&self.rgb), 3, &wide(&self.background));
        let (values, errors) = reference::forward(&loss, &out, &out.color);
        Want { d: reference::backward(&loss, &out), out, values, errors }
    }
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for case in cases() {
        let want = case.want();
        let left_out: Vec<u32> = case.counts.iter().map(|c| !c as u32).collect();
        let rays = OnGpu {
            shape: format!("R={} S={} {:?} {:?}", case.counts.len(), case.scene.t.len(), case.terms, case.measure),
            packed: GpuPacked::upload(gpu, &case.scene.packed()),
            rgba: gpu.upload(&case.rgba),
            background: gpu.upload(&case.background),
            left_out: gpu.upload(&left_out),
            cut: gpu.upload(&case.cut),
            distance: gpu.upload(&case.distance),
        };
        rays.check_composited(gpu, table, &case, &want)?;
        for near in [0.0, NEAR] {
            rays.check_at_once(gpu, table, &case, &want, near)?;
        }
    }
    Ok(())
}

/// A case on the device.
#[cfg(feature = "gpu")]
struct OnGpu {
    shape: String,
    packed: GpuPacked,
    rgba: Buffer,
    background: Buffer,
    left_out: Buffer<u32>,
    cut: Buffer<u32>,
    distance: Buffer,
}

#[cfg(feature = "gpu")]
impl OnGpu {
    fn target(&self) -> Target<'_> {
        Target { rgba: &self.rgba, background: &self.background, left_out: &self.left_out, distance: &self.distance }
    }

    /// Rays that were composited before.
    fn check_composited(&self, gpu: &Gpu, table: &mut Table, case: &Case, want: &Want) -> Result<(), GpuError> {
        let up = |v: &[f64]| gpu.upload(&v.iter().map(|v| *v as f32).collect::<Vec<f32>>());
        let (out, d, sums) = (&want.out, &want.d, gpu.zeros(SUMS));
        let out = GpuComposited { color: up(&out.color), depth: up(&out.depth), opacity: up(&out.opacity), weights: up(&out.weights) };
        let figures = Figures { sums: &sums, marched: &self.packed.offsets, cut: &self.cut, is_main: true };
        let (got, errors) = on_gpu::loss(gpu, (case.terms, case.measure), &self.packed, &out, self.target(), figures);
        table.close("loss", "errors", &self.shape, &errors, &want.errors)?;
        table.close("loss", "d color", &self.shape, &got.color, &d.color)?;
        table.close("loss", "d opacity", &self.shape, &got.opacity, &d.opacity)?;
        table.close("loss", "d weights", &self.shape, &got.weights, &d.weights)?;
        self.check_figures(gpu, table, "loss", (case, want), &sums)
    }

    /// Compositing and loss in one launch; gradients closer to the camera than `near` are scaled.
    fn check_at_once(&self, gpu: &Gpu, table: &mut Table, case: &Case, want: &Want, near: f32) -> Result<(), GpuError> {
        let (p, sums) = (case.scene.packed(), gpu.zeros(SUMS));
        let (sigma, rgb) = (gpu.upload(&case.scene.sigma), gpu.upload(&case.rgb));
        let figures = Figures { sums: &sums, marched: &self.packed.offsets, cut: &self.cut, is_main: true };
        let loss = (case.terms, case.measure);
        let (g, errors) = on_gpu::composite_and_loss(gpu, loss, &self.packed, (&sigma, &rgb), self.target(), near, figures);
        let (sigma, rgb, background) = (wide(&case.scene.sigma), wide(&case.rgb), wide(&case.background));
        let (ds, dc, db) = composite::reference::backward(&p, &sigma, &rgb, 3, &background, &want.d);
        let scaled =
            |d: &[f64], width: usize| -> Vec<f64> { d.iter().zip(0..).map(|(d, i)| d * near_share(&p, i / width, near)).collect() };
        let shape = format!("{} near scaling {near}", self.shape);
        table.close("composite + loss", "errors", &shape, &errors, &want.errors)?;
        table.close("composite + loss", "d sigma", &shape, &g.sigma, &scaled(&ds, 1))?;
        table.close("composite + loss", "d rgb", &shape, &g.features, &scaled(&dc, 3))?;
        table.close("composite + loss", "d background", &shape, &g.background, &db)?;
        self.check_figures(gpu, table, "composite + loss", (case, want), &sums)
    }

    /// The step's figures.
    fn check_figures(
        &self,
        gpu: &Gpu,
        table: &mut Table,
        op: &'static str,
        (case, want): (&Case, &Want),
        sums: &Buffer,
    ) -> Result<(), GpuError> {
        let (sums, s, rays) = (gpu.read(sums)?, case.scene.t.len() as f64, case.counts.len());
        let whole: Vec<usize> = (0..rays).filter(|r| case.cut[*r] == 0).collect();
        let trained: u32 = whole.iter().map(|r| case.scene.offsets[r + 1] - case.scene.offsets[*r]).sum();
        let counted = case.counts.iter().filter(|c| **c).count();
        let means = [want.values.iter().sum::<f64>() / rays.max(1) as f64, want.errors.iter().sum::<f64>() / counted.max(1) as f64];
        table.close(op, "sums", &self.shape, &gpu.upload(&sums[..2]), &means)?;
        table.close(op, "counts", &self.shape, &gpu.upload(&sums[2..]), &[trained as f64, s, whole.len() as f64, 1.0])
    }
}
