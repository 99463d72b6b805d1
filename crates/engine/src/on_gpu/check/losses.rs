//! Checks of the photometric loss: as a kernel of its own, and fused with compositing.

use super::*;

/// Closer to the camera than this, gradients are scaled.
const NEAR: f32 = 1.0;

/// Composited rays, and the photographs that they are compared with.
struct Compared {
    scene: Ragged,
    batch: RayBatch,
    rgb: Vec<f32>,
    background: Vec<f32>,
    out: Composited<f32>,
}

impl Compared {
    fn new(rays: usize) -> Compared {
        let scene = Ragged::new(rays);
        let mut batch = RayBatch::default();
        batch.resize(rays);
        batch.target = random_unit(rays * 4, 7);
        batch.counts.iter_mut().skip(2).step_by(9).for_each(|c| *c = false);
        // Every third ray's surface is known.
        batch.distance.iter_mut().step_by(3).zip(random_unit(rays, 10)).for_each(|(d, u)| *d = 0.1 + 3.0 * u);
        let (rgb, background) = (random_unit(scene.t.len() * 3, 8), random_unit(rays * 3, 9));
        let out = composite::forward(&scene.packed(), &scene.sigma, &rgb, 3, &background);
        Compared { scene, batch, rgb, background, out }
    }
}

/// Loss and gradients by the CPU.
struct Expected {
    value: f64,
    /// Mean squared error of the rays that count, and of each ray.
    error: f64,
    of_rays: Vec<f64>,
    d: Composited<f64>,
}

impl Expected {
    fn new(c: &Compared, photometric: &Photometric) -> Expected {
        let (p, rays) = (c.scene.packed(), c.batch.len());
        let (mut value, mut error, mut counted) = (0.0f64, 0.0f64, 0usize);
        let mut of_rays = vec![0.0f64; rays];
        let (mut d_color, mut d_opacity, mut d_weights) = (vec![0.0; rays * 3], vec![0.0; rays], vec![0.0; p.samples()]);
        for r in 0..rays {
            let rgb = [0, 1, 2].map(|k: usize| c.out.color[r * 3 + k]);
            let o = RayOutput {
                values: &rgb,
                opacity: c.out.opacity[r],
                depth: c.out.depth[r],
                weights: &c.out.weights[p.range(r)],
                first: p.range(r).start,
            };
            let values = &mut d_color[r * 3..r * 3 + 3];
            let mut g = RayGradient { values, opacity: 0.0, depth: 0.0, weights: &mut d_weights[p.range(r)] };
            value += photometric.ray(r, &o, &mut g);
            d_opacity[r] = g.opacity;
            if c.batch.counts[r] {
                of_rays[r] = photometric.squared_error(rgb, photometric.target(r)) as f64;
                error += of_rays[r];
                counted += 1;
            }
        }
        let d = Composited { color: wide(&d_color), depth: vec![0.0; rays], opacity: wide(&d_opacity), weights: wide(&d_weights) };
        Expected { value, error: error / counted as f64, of_rays, d }
    }
}

/// The rays on the device.
struct OnGpu {
    packed: GpuPacked,
    rgba: Buffer,
    background: Buffer,
    left_out: Buffer<u32>,
    distance: Buffer,
}

impl OnGpu {
    fn upload(gpu: &Gpu, c: &Compared) -> OnGpu {
        let left_out: Vec<u32> = c.batch.counts.iter().map(|c| !c as u32).collect();
        OnGpu {
            packed: GpuPacked::upload(gpu, &c.scene.packed()),
            rgba: gpu.upload(&c.batch.target),
            background: gpu.upload(&c.background),
            left_out: gpu.upload(&left_out),
            distance: gpu.upload(&c.batch.distance),
        }
    }

    fn target(&self) -> Target<'_> {
        Target { rgba: &self.rgba, background: &self.background, left_out: &self.left_out, distance: &self.distance }
    }
}

/// One loss of some rays.
struct Case<'a> {
    rays: &'a Compared,
    on_gpu: &'a OnGpu,
    terms: Terms,
    want: Expected,
    shape: String,
}

pub(super) fn losses(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for rays in [1, 130] {
        let compared = Compared::new(rays);
        let (p, on_gpu) = (compared.scene.packed(), OnGpu::upload(gpu, &compared));
        let (mut starts, mut lengths) = (Vec::new(), Vec::new());
        distortion::cpu::normalize(&p, &mut starts, &mut lengths);
        let in_distance = Packed { t: &starts, dt: &lengths, ..p };
        let wide_huber = ColorLoss::Huber(0.1);
        for (color, relative, normalized, depth) in
            [(ColorLoss::Mse, 0.0, true, 0.4), (wide_huber, 0.0, false, 0.0), (wide_huber, 0.05, false, 0.4)]
        {
            let (distortion, alpha) = (0.3, 0.2);
            let photometric = Photometric {
                batch: &compared.batch,
                samples: if normalized { in_distance } else { p },
                background: &compared.background,
                color,
                relative,
                distortion,
                alpha,
                depth,
                along: p,
            };
            let shape = format!("R={rays} S={} {color:?} relative {relative} normalized={normalized} depth={depth}", p.samples());
            let terms = Terms { color, relative, distortion, normalized, alpha, depth };
            let case = Case { rays: &compared, on_gpu: &on_gpu, terms, want: Expected::new(&compared, &photometric), shape };
            case.apart(gpu, table)?;
            for reach in [0.0, NEAR] {
                case.at_once(gpu, table, reach)?;
            }
        }
        near_scaling(gpu, table, &compared.scene)?;
    }
    Ok(())
}

impl Case<'_> {
    /// Of what was composited before.
    fn apart(&self, gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
        let (out, on, want, shape) = (&self.rays.out, self.on_gpu, &self.want, &self.shape);
        let (up, sums) = (|v: &[f32]| gpu.upload(v), gpu.zeros(SUMS));
        let out = GpuComposited { color: up(&out.color), depth: up(&out.depth), opacity: up(&out.opacity), weights: up(&out.weights) };
        let figures = Figures { sums: &sums, marched: &on.packed.offsets, is_main: true };
        let (d, errors) = loss::loss(gpu, self.terms, &on.packed, &out, on.target(), figures);
        table.close("loss", "errors", shape, &errors, &want.of_rays)?;
        table.close("loss", "d color", shape, &d.color, &want.d.color)?;
        table.close("loss", "d opacity", shape, &d.opacity, &want.d.opacity)?;
        table.close("loss", "d weights", shape, &d.weights, &want.d.weights)?;
        self.figures(gpu, table, "loss", shape, &sums)
    }

    /// With compositing; gradients closer than `reach` are scaled.
    fn at_once(&self, gpu: &Gpu, table: &mut Table, reach: f32) -> Result<(), GpuError> {
        let (scene, on, want) = (&self.rays.scene, self.on_gpu, &self.want);
        let (sigma, rgb, sums) = (gpu.upload(&scene.sigma), gpu.upload(&self.rays.rgb), gpu.zeros(SUMS));
        let figures = Figures { sums: &sums, marched: &on.packed.offsets, is_main: true };
        let (g, errors) = loss::composite_and_loss(gpu, self.terms, &on.packed, (&sigma, &rgb), on.target(), reach, figures);
        let shape = &format!("{} near scaling {reach}", self.shape);
        table.close("composite + loss", "errors", shape, &errors, &want.of_rays)?;
        let (sigma, rgb, background) = (wide(&scene.sigma), wide(&self.rays.rgb), wide(&self.rays.background));
        let (ds, dc, db) = reference::backward(&scene.packed(), &sigma, &rgb, 3, &background, &want.d);
        let kept = |i: usize| if reach > 0.0 { share(scene, i, reach) } else { 1.0 };
        let scaled = |d: &[f64], width: usize| -> Vec<f64> { d.iter().enumerate().map(|(i, d)| d * kept(i / width)).collect() };
        table.close("composite + loss", "d sigma", shape, &g.sigma, &scaled(&ds, 1))?;
        table.close("composite + loss", "d rgb", shape, &g.features, &scaled(&dc, 3))?;
        table.close("composite + loss", "d background", shape, &g.background, &db)?;
        self.figures(gpu, table, "composite + loss", shape, &sums)
    }

    fn figures(&self, gpu: &Gpu, table: &mut Table, op: &'static str, shape: &str, sums: &Buffer) -> Result<(), GpuError> {
        let (sums, s) = (gpu.read(sums)?, self.rays.scene.t.len() as f64);
        table.close(op, "sums", shape, &gpu.upload(&sums[..2]), &[self.want.value, self.want.error])?;
        table.close(op, "counts", shape, &gpu.upload(&sums[2..]), &[s, s, 1.0])
    }
}

/// What of a sample's gradient is kept.
fn share(scene: &Ragged, i: usize, reach: f32) -> f64 {
    ((scene.t[i] + 0.5 * scene.dt[i]) / reach).min(1.0).powi(2) as f64
}

/// Gradients close to the camera.
fn near_scaling(gpu: &Gpu, table: &mut Table, scene: &Ragged) -> Result<(), GpuError> {
    let s = scene.t.len();
    let (d_sigma, d_rgb) = (random(s, 3), random(s * 3, 4));
    let (got_sigma, got_rgb) = (gpu.upload(&d_sigma), gpu.upload(&d_rgb));
    field::scale_near_gradients(gpu, &GpuPacked::upload(gpu, &scene.packed()), &got_sigma, &got_rgb, NEAR);
    let shape = format!("S={s}");
    let want: Vec<f64> = (0..s).map(|i| d_sigma[i] as f64 * share(scene, i, NEAR)).collect();
    table.close("near scaling", "d sigma", &shape, &got_sigma, &want)?;
    let want: Vec<f64> = (0..s * 3).map(|i| d_rgb[i] as f64 * share(scene, i / 3, NEAR)).collect();
    table.close("near scaling", "d rgb", &shape, &got_rgb, &want)
}
