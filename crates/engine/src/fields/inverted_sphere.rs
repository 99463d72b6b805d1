//! Background: density and color outside of a sphere, by inverse distance (Zhang et al. 2020, "NeRF++", section 4): a point at `r ≥ 1` radii from the center in
//! the direction `(x, y, z)` is `(x, y, z, 1/r)`, so that all of space is in the unit cube.

use super::presets::trunk;
use crate::params::ParamGroup;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::field_step::{
    self, BlockEncoding, Extras, FieldNet, InjectedGradients, Positions, RayGradients, StepBuffers, StepInput, StepOutput,
};
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::march::Marched;

/// Coordinates of a point.
const DIMS: usize = 4;
/// Output layers are padded to a whole vector.
const PADDED: usize = 16;
/// Layers of the trunk.
const TRUNK: usize = 8;
/// Length of the last interval of a ray: space goes on.
const ENDLESS: f32 = 1e10;

/// A sphere in model space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    pub center: [f32; 3],
    pub radius: f32,
}

impl Sphere {
    /// Distance at which a ray leaves the sphere of `times` its radius; none where it does not enter it.
    pub fn exit(&self, origin: &[f32], dir: &[f32], times: f32) -> Option<f32> {
        let o = [0, 1, 2].map(|k| origin[k] - self.center[k]);
        let dot = |a: &[f32], b: &[f32]| -> f32 { (0..3).map(|k| a[k] * b[k]).sum() };
        let (closest, reach) = (-dot(&o, dir), self.radius * times);
        let square = closest * closest - dot(&o, &o) + reach * reach;
        (square >= 0.0).then(|| closest + square.sqrt()).filter(|t| *t > 0.0)
    }

    /// Ends rays where they leave the sphere; those that never enter it become empty.
    ///
    /// # Shapes
    /// origins, dirs: `[R, 3]`; near_far: `[R, 2]`.
    pub fn cut(&self, origins: &[f32], dirs: &[f32], near_far: &mut [f32]) {
        for ((origin, dir), near_far) in origins.chunks_exact(3).zip(dirs.chunks_exact(3)).zip(near_far.chunks_exact_mut(2)) {
            near_far[1] = near_far[1].min(self.exit(origin, dir, 1.0).unwrap_or(0.0)).max(near_far[0]);
        }
    }
}

/// A density and a color `[3]`, sRGB, outside of a sphere.
#[derive(Clone, Debug)]
pub struct InvertedSphere {
    pub sphere: Sphere,
    pub encoding: Frequency,
    pub net: FieldNet,
    pub weights: ParamGroup,
}

/// Samples of rays outside of a sphere, in `1 − 1/r`; memory kept between batches.
#[derive(Default)]
pub struct OuterSamples {
    pub samples: Marched,
    /// `[S, 4]`
    pub points: Vec<f32>,
    /// Lengths of the intervals; the last of each ray has no end.
    pub dt: Vec<f32>,
    step: StepBuffers,
    pub out: StepOutput,
}

impl InvertedSphere {
    /// NeRF's trunk with a rectified density, then 256 → 128 → 3. `stream` tells networks of one seed apart.
    pub fn new(sphere: Sphere, bands: usize, width: usize, adam: Adam, seed: u64, stream: u64) -> InvertedSphere {
        use Source::Layer as L;
        let encoding = Frequency { dims: DIMS, bands, include_input: true, pi: false, window: None };
        let mut layers = trunk(width);
        layers.push(Layer::new(vec![L(TRUNK - 1)], PADDED, Activation::None, true));
        layers.push(Layer::new(vec![L(TRUNK - 1)], width, Activation::None, true));
        layers.push(Layer::new(vec![L(TRUNK + 1)], width / 2, Activation::Relu, true));
        layers.push(Layer::new(vec![L(TRUNK + 2)], PADDED, Activation::None, true));
        let head = |layer, activation| Head { layer, channel: 0, activation, shift: 0.0 };
        let net = FieldNet::of_color(
            Mlp::new(vec![encoding.output_dims()], layers),
            head(TRUNK, Activation::Relu),
            head(TRUNK + 3, Activation::Sigmoid),
        );
        let weights = ParamGroup::dense("weights", net.mlp.init(&Rng::new(seed, stream)), adam);
        InvertedSphere { sphere, encoding, net, weights }
    }

    /// Finds the points of `on.samples` on rays `[R, 3]`; where a ray that begins outside misses a sphere, samples have no length.
    pub fn locate(&self, origins: &[f32], dirs: &[f32], on: &mut OuterSamples) {
        on.points.clear();
        on.dt.clone_from(&on.samples.dt);
        for r in 0..on.samples.offsets.len() - 1 {
            let (origin, dir) = (&origins[3 * r..3 * r + 3], &dirs[3 * r..3 * r + 3]);
            let of = on.samples.offsets[r] as usize..on.samples.offsets[r + 1] as usize;
            for i in of.clone() {
                let inverse = (1.0 - on.samples.t[i] - 0.5 * on.samples.dt[i]).max(1e-6);
                let Some(t) = self.sphere.exit(origin, dir, 1.0 / inverse) else {
                    // A camera outside sees nothing of this sphere.
                    on.points.extend([0.0, 0.0, 0.0, inverse]);
                    on.dt[i] = 0.0;
                    continue;
                };
                let at = |k: usize| (origin[k] + t * dir[k] - self.sphere.center[k]) * inverse / self.sphere.radius;
                on.points.extend([at(0), at(1), at(2), inverse]);
            }
            if let Some(last) = of.last().filter(|i| on.dt[*i] > 0.0) {
                on.dt[last] = ENDLESS;
            }
        }
    }

    /// Composites located samples into `on.out`; with gradients `[R, 3]` of the colors, adds those of the weights.
    pub fn run(&mut self, on: &mut OuterSamples, d_rgb: Option<Vec<f32>>) {
        let mut grads = std::mem::take(&mut self.weights.grads);
        self.pass(on, d_rgb, &mut grads);
        self.weights.grads = grads;
    }

    /// Composites located samples into `on.out`.
    pub fn render(&self, on: &mut OuterSamples) {
        self.pass(on, None, &mut []);
    }

    fn pass(&self, on: &mut OuterSamples, d_rgb: Option<Vec<f32>>, grads: &mut [f32]) {
        let samples = Packed { offsets: &on.samples.offsets, t: &on.samples.t, dt: &on.dt };
        let (rays, background) = (samples.rays(), vec![0.0; 3 * samples.rays()]);
        let input = StepInput {
            net: &self.net,
            params: &self.weights.values,
            samples,
            extras: Extras::default(),
            background: &background,
            beside: None,
            near_scaling: 0.0,
        };
        let positions = Positions::Encoded { encoding: BlockEncoding::Frequency(self.encoding), points: &on.points, d_points: None };
        let gradients = d_rgb.map(|values| RayGradients { values, opacity: vec![0.0; rays], depth: vec![0.0; rays] });
        let injected = gradients.as_ref().map(InjectedGradients);
        let loss = injected.as_ref().map(|i| i as &dyn field_step::RayLoss);
        field_step::run(&input, positions, &mut [], loss, &mut on.step, &mut on.out, grads);
    }

    /// A copy of the values alone, for rendering; it cannot be trained.
    pub fn for_rendering(&self) -> InvertedSphere {
        InvertedSphere { weights: self.weights.values_only(), net: self.net.clone(), ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_kernels::ops::strata::cpu as strata;

    /// Rays from inside a sphere, with 16 samples outside.
    fn rays(inverted: &InvertedSphere) -> OuterSamples {
        let mut on = OuterSamples::default();
        strata::stratified(&[0.0, 1.0, 0.0, 1.0], 16, None, &mut on.samples);
        inverted.locate(&[0.5, 0.5, 0.5, 0.7, 0.4, 0.6], &[1.0, 0.0, 0.0, 0.0, 0.6, 0.8], &mut on);
        on
    }

    fn small() -> InvertedSphere {
        let sphere = Sphere { center: [0.5; 3], radius: 2.0 };
        let mut out = InvertedSphere::new(sphere, 3, 16, Adam { rate: 1e-2, ..Adam::default() }, 1, 2);
        // Matter everywhere, so that no rectifier hides what is wrong.
        let density = out.net.mlp.offsets[TRUNK] + 16 * PADDED;
        out.weights.values[density] = 0.5;
        out
    }

    #[test]
    fn points_lie_on_their_spheres_and_on_the_unit_sphere_of_directions() {
        let inverted = small();
        let on = rays(&inverted);
        for p in on.points.chunks_exact(4) {
            let length = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
            assert!((length - 1.0).abs() < 1e-3 && p[3] > 0.0 && p[3] < 1.0, "{p:?}");
        }
        // The first ray runs along x through the center.
        assert!(on.points[..64].chunks_exact(4).all(|p| (p[0] - 1.0).abs() < 1e-5));
        // The second sees ever more of its own direction.
        assert!((on.points[125] - 0.6).abs() < 0.02 && (on.points[126] - 0.8).abs() < 0.02, "{:?}", &on.points[124..]);
    }

    #[test]
    fn rays_end_at_the_sphere_and_cameras_outside_may_miss_it() {
        let s = Sphere { center: [0.5; 3], radius: 2.0 };
        let (origins, dirs) = ([0.5, 0.5, 0.5, 4.0, 0.5, 0.5, 4.0, 0.5, 0.5], [1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        let mut near_far = [0.1, 9.0].repeat(3);
        s.cut(&origins, &dirs, &mut near_far);
        assert_eq!(near_far, [0.1, 2.0, 0.1, 5.5, 0.1, 0.1]);
        let (inverted, mut on) = (small(), OuterSamples::default());
        strata::stratified(&[0.0, 1.0], 16, None, &mut on.samples);
        inverted.locate(&origins[6..], &dirs[6..], &mut on);
        // At right angles, it meets those spheres alone that hold it.
        let is_met: Vec<bool> = on.dt.iter().map(|d| *d > 0.0).collect();
        assert!(!is_met[0] && is_met[15] && is_met.windows(2).all(|w| w[0] <= w[1]), "{is_met:?}");
    }

    #[test]
    fn gradients_equal_differences() {
        let mut inverted = small();
        let mut on = rays(&inverted);
        let weights = [0.3f32, -0.7, 0.2, 0.5, 0.1, -0.4];
        inverted.run(&mut on, Some(weights.to_vec()));
        let grads = inverted.weights.grads.clone();
        let mut value = |inverted: &InvertedSphere| -> f64 {
            inverted.render(&mut on);
            on.out.values.iter().zip(weights).map(|(v, w)| (*v * w) as f64).sum()
        };
        let (mut checked, step) = (0, 1e-2);
        for i in (0..grads.len()).filter(|i| grads[*i].abs() > 0.01).step_by(7) {
            let at = inverted.weights.values[i];
            inverted.weights.values[i] = at + step;
            let up = value(&inverted);
            inverted.weights.values[i] = at - step;
            let down = value(&inverted);
            inverted.weights.values[i] = at;
            let want = (up - down) / (2.0 * step as f64);
            assert!((grads[i] as f64 - want).abs() < 0.05 * want.abs() + 2e-3, "{i}: {} for {want}", grads[i]);
            checked += 1;
        }
        assert!(checked > 5, "{checked}");
    }
}
