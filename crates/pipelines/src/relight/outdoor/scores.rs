//! Scores of the scene model against a generated benchmark.

use super::model::SceneModel;
use super::render::{FineViews, SceneView, ViewLight};
use crate::error::{PipelineError, Result};
use crate::relight::light::{LightOptions, Source};
use crate::relight::truth::{self, LightTruth, Truth, ViewLayers};
use diorama_data::photo;
use diorama_geom::capture::Split;
use diorama_geom::color::{linear_from_srgb, srgb_from_linear};
use diorama_geom::glam::DVec3;
use diorama_geom::{Image, ImageU8};
use serde::Serialize;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::path::Path;

/// Scores over the pixels of held-out views that show opaque surfaces.
#[derive(Clone, Debug, Default, Serialize)]
pub struct SceneScores {
    /// Under the light that training never saw, given as spherical harmonics.
    pub unseen_light_psnr: f64,
    /// The same by exact albedo, normals and shadow, under the same harmonics.
    pub oracle_psnr: f64,
    /// The mean of the pictures in all lights of training in place of the model's.
    pub mean_light_psnr: f64,
    /// The same three in a second light that training never saw, whose sun is veiled; NaN where the benchmark has none.
    pub veiled_light_psnr: f64,
    pub veiled_oracle_psnr: f64,
    pub veiled_mean_psnr: f64,
    /// Views that were held out in the lights of training.
    pub seen_light_psnr: f64,
    /// Those of them whose light has a sun.
    pub sunlit_psnr: f64,
    /// How the model takes light: `sh` or `sun`.
    pub light: String,
    /// Of linear albedo after one factor per channel.
    pub albedo_psnr: f64,
    pub normal_median_deg: f64,
    /// Median error of the distance, as a share of it.
    pub depth_median: f64,
    /// Correlation of the shadow with the share of direct light that arrives.
    pub shadow_correlation: f64,
    pub views: usize,
}

/// A held-out view in an unseen light, layer by layer: picture, albedo, normal, shadow and depth.
pub struct Sheet {
    pub ours: Vec<ImageU8>,
    pub exact: Vec<ImageU8>,
}

/// Errors in a light that training never saw: the model's, those of exact layers under the light's harmonics, and those of the mean picture.
#[derive(Default)]
struct InLight {
    ours: Errors,
    oracle: Errors,
    mean: Errors,
}

/// Sum of squares of errors in sRGB.
#[derive(Default)]
struct Errors {
    sum: f64,
    n: usize,
}

impl Errors {
    fn add(&mut self, linear: [f32; 3], srgb: [f32; 3]) {
        for k in 0..3 {
            let e = srgb_from_linear(linear[k].clamp(0.0, 1.0)) - srgb[k];
            self.sum += (e * e) as f64;
        }
        self.n += 3;
    }

    fn psnr(&self) -> f64 {
        -10.0 * (self.sum / self.n as f64).log10()
    }
}

/// What was found in the pixels of held-out views.
#[derive(Default)]
struct Tally {
    unseen: InLight,
    veiled: InLight,
    seen: Errors,
    sunlit: Errors,
    albedos: Vec<([f32; 3], [f32; 3])>,
    angles: Vec<f64>,
    shadows: Vec<(f64, f64)>,
    depths: Vec<f64>,
    views: usize,
}

/// A held-out view in a light, and what is exact of it.
struct Judged<'a> {
    view: &'a SceneView,
    photograph: &'a ImageU8,
    layers: &'a ViewLayers,
    shadow: &'a Image,
    light: &'a LightTruth,
    is_seen: bool,
    is_unseen: bool,
    /// Mean of the view's pictures in the lights of training, in a light that is not one of them.
    mean: Option<Image>,
    /// Model space per meter.
    per_meter: f32,
}

impl Tally {
    fn add(&mut self, j: &Judged) {
        let (exact, of_light) = (j.light.light(), if j.is_unseen { &mut self.unseen } else { &mut self.veiled });
        for i in valid(j.layers) {
            let rgb = |image: &Image| -> [f32; 3] { std::array::from_fn(|k| image.data[3 * i + k]) };
            let photo: [f32; 3] = std::array::from_fn(|k| j.photograph.data[j.photograph.channels * i + k] as f32 / 255.0);
            let (got, normal, albedo) = (rgb(&j.view.color), rgb(&j.view.normal), rgb(&j.layers.albedo));
            let n = DVec3::from(rgb(&j.layers.normal).map(f64::from)).normalize_or_zero();
            let shadow = j.shadow.data[3 * i];
            self.shadows.push((j.view.shadow.data[i] as f64, shadow as f64));
            if j.is_seen {
                self.seen.add(got, photo);
                if j.light.sun.is_some() {
                    self.sunlit.add(got, photo);
                }
            } else {
                let lit = exact.shade(n);
                of_light.ours.add(got, photo);
                of_light.oracle.add(std::array::from_fn(|k| albedo[k] * lit[k].max(0.0) as f32 * shadow), photo);
                j.mean.iter().for_each(|m| of_light.mean.add(rgb(m), photo));
            }
            if j.is_unseen {
                self.albedos.push((rgb(&j.view.albedo), albedo));
                let depth = j.per_meter * j.layers.depth.data[i];
                self.depths.push(((j.view.depth.data[i] - depth) / depth).abs() as f64);
                self.angles.push(n.dot(DVec3::from(normal.map(f64::from))).clamp(-1.0, 1.0).acos().to_degrees());
            }
        }
        self.views += j.is_unseen as usize;
    }

    fn scores(self, light: &str) -> SceneScores {
        SceneScores {
            unseen_light_psnr: self.unseen.ours.psnr(),
            oracle_psnr: self.unseen.oracle.psnr(),
            mean_light_psnr: self.unseen.mean.psnr(),
            veiled_light_psnr: self.veiled.ours.psnr(),
            veiled_oracle_psnr: self.veiled.oracle.psnr(),
            veiled_mean_psnr: self.veiled.mean.psnr(),
            seen_light_psnr: self.seen.psnr(),
            sunlit_psnr: self.sunlit.psnr(),
            light: light.into(),
            albedo_psnr: scaled_psnr(&self.albedos),
            normal_median_deg: median(self.angles),
            depth_median: median(self.depths),
            shadow_correlation: correlation(&self.shadows),
            views: self.views,
        }
    }
}

/// Judges a model by pictures with `samples`² rays per pixel; `look` receives the name of each held-out photograph in a light that training never saw, and its layers,
/// and `progress` the share that is done.
///
/// # Errors
/// When the data set has no truth, or files are missing.
pub fn judge(
    model: &SceneModel,
    data: &Path,
    samples: u32,
    look: &mut dyn FnMut(&str, &Sheet) -> Result<()>,
    progress: &mut dyn FnMut(f64),
) -> Result<SceneScores> {
    if !Truth::exists(data) {
        return Err(PipelineError::Usage(format!("{}: has no truth; only generated benchmarks do", data.display())));
    }
    let truth = Truth::read(data)?;
    let gauge = gauge(model, data, &truth)?;
    let per_meter = model.model_from_world.scale as f32;
    let (mut tally, mut fine, mut lights) = (Tally::default(), FineViews::new(model, samples)?, HashMap::new());
    let held_out = model.capture.indices(Split::Test);
    for (done, frame) in held_out.iter().copied().enumerate() {
        progress(done as f64 / held_out.len() as f64);
        let name = &model.capture.frames[frame].name;
        let Some(of) = truth.views.iter().find(|v| name.ends_with(&v.photograph)) else { continue };
        let photograph = photo::load(&model.capture.frames[frame].image)?;
        let layers = truth::read_view(data, &of.view)?;
        let (light, is_unseen, is_seen) = (&truth.lights[of.light], of.light == truth.unseen, truth.is_seen(of.light));
        let view_light = match lights.entry(of.light) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(match model.light_of_frame(frame).filter(|_| is_seen) {
                Some(l) => ViewLight::learned(model, l),
                None => given(model, data, light, gauge)?,
            }),
        };
        let view = fine.view(&model.posed(frame), view_light);
        let shadow = truth::read_shadow(data, &of.photograph)?;
        let mean = if is_seen { None } else { mean_picture(data, &truth, &of.view)? };
        let (view, photograph, layers, shadow) = (&view, &photograph, &layers, &shadow);
        tally.add(&Judged { view, photograph, layers, shadow, light, is_seen, is_unseen, mean, per_meter });
        if !is_seen {
            look(&of.photograph, &sheet(view, photograph, layers, shadow, per_meter))?;
        }
    }
    Ok(tally.scores(if model.has_suns() { "sun" } else { "sh" }))
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn sheet(view: &SceneView, photograph: &ImageU8, layers: &ViewLayers, shadow: &Image, per_meter: f32) -> Sheet {
    let farthest = layers.depth.data.iter().zip(&layers.valid.data).filter(|(_, v)| **v > 0.5).map(|(d, _)| *d).fold(1e-6, f32::max);
    // Three channels of each pixel, as people look at them.
    let shown = |image: &Image, of: &dyn Fn(f32) -> f32| {
        let c = image.channels;
        let pixels = image.data.chunks_exact(c).flat_map(|p| [0, 1, 2].map(|k| of(p[if c == 3 { k } else { 0 }])));
        Image { width: image.width, height: image.height, channels: 3, data: pixels.collect() }.to_u8()
    };
    let srgb = |v: f32| srgb_from_linear(v.clamp(0.0, 1.0));
    let normal = |v: f32| 0.5 * v + 0.5;
    let first = Image { channels: 1, data: shadow.data.iter().step_by(3).copied().collect(), ..*shadow };
    Sheet {
        ours: vec![
            encoded(&view.color),
            shown(&view.albedo, &srgb),
            shown(&view.normal, &normal),
            shown(&view.shadow, &|v| v),
            shown(&view.depth, &|v| v / (per_meter * farthest)),
        ],
        exact: vec![
            photograph.clone(),
            shown(&layers.albedo, &srgb),
            shown(&layers.normal, &normal),
            shown(&first, &|v| v),
            shown(&layers.depth, &|v| v / farthest),
        ],
    }
}

fn valid(layers: &ViewLayers) -> impl Iterator<Item = usize> + '_ {
    (0..layers.valid.data.len()).filter(|i| layers.valid.data[*i] > 0.5)
}

/// sRGB of a linear image.
pub fn encoded(linear: &Image) -> ImageU8 {
    let data = linear.data.iter().map(|v| srgb_from_linear(v.clamp(0.0, 1.0))).collect();
    Image { data, ..linear.clone() }.to_u8()
}

/// Factor by channel from exact light to the model's: that by which the model's albedo is too dark in the median, as brightness is shared between
/// albedo and light by chance.
fn gauge(model: &SceneModel, data: &Path, truth: &Truth) -> Result<[f64; 3]> {
    let (mut pairs, light) = (Vec::new(), ViewLight::learned(model, 0));
    for frame in model.capture.indices(Split::Test) {
        let name = &model.capture.frames[frame].name;
        let Some(of) = truth.views.iter().find(|v| v.light == truth.unseen && name.ends_with(&v.photograph)) else { continue };
        let layers = truth::read_view(data, &of.view)?;
        let view = model.view(&model.posed(frame), &light, &mut |_| {});
        let rgb = |image: &Image, i: usize| -> [f32; 3] { std::array::from_fn(|k| image.data[3 * i + k]) };
        pairs.extend(valid(&layers).map(|i| (rgb(&view.albedo, i), rgb(&layers.albedo, i))));
    }
    let ratio = |k: usize| pairs.iter().map(|(got, want)| want[k] as f64 / got[k].max(1e-3) as f64).collect();
    Ok(std::array::from_fn(|k| median(ratio(k))))
}

/// The factor by which a channel of the first colors comes nearest to that of the second.
fn factor(pairs: &[([f32; 3], [f32; 3])], k: usize) -> f64 {
    let of = |f: &dyn Fn(f64, f64) -> f64| pairs.iter().map(|(got, want)| f(got[k] as f64, want[k] as f64)).sum::<f64>();
    of(&|g, w| g * w) / of(&|g, _| g * g).max(1e-12)
}

/// An exact light, scaled, as a file gives it to users.
fn given(model: &SceneModel, data: &Path, exact: &LightTruth, by: [f64; 3]) -> Result<ViewLight> {
    let (light, _) = LightOptions::of(Source::File(truth::light_file(data, &exact.name))).read()?;
    Ok(ViewLight::of_daylight(model, &light.sun_apart(), by))
}

/// Mean in linear light of the photographs of a view in the lights of training.
fn mean_picture(data: &Path, truth: &Truth, view: &str) -> Result<Option<Image>> {
    let mut sum: Option<Image> = None;
    let mut n = 0.0;
    for v in truth.views.iter().filter(|v| v.view == view && truth.is_seen(v.light)) {
        let mut photograph = photo::load(&data.join("images").join(format!("{}.png", v.photograph)))?.to_f32();
        photograph.data.iter_mut().for_each(|v| *v = linear_from_srgb(*v));
        match &mut sum {
            Some(sum) => sum.data.iter_mut().zip(&photograph.data).for_each(|(s, v)| *s += v),
            None => sum = Some(photograph),
        }
        n += 1.0;
    }
    sum.iter_mut().for_each(|s| s.data.iter_mut().for_each(|v| *v /= n));
    Ok(sum)
}

/// PSNR of linear colors after the best factor per channel.
fn scaled_psnr(pairs: &[([f32; 3], [f32; 3])]) -> f64 {
    let mut sum = 0.0;
    for k in 0..3 {
        let of = |f: &dyn Fn(f64, f64) -> f64| pairs.iter().map(|(got, want)| f(got[k] as f64, want[k] as f64)).sum::<f64>();
        let factor = factor(pairs, k);
        sum += of(&|g, w| (factor * g - w) * (factor * g - w));
    }
    -10.0 * (sum / (3 * pairs.len()).max(1) as f64).log10()
}

/// Pearson's correlation.
fn correlation(pairs: &[(f64, f64)]) -> f64 {
    let n = pairs.len() as f64;
    let mean = |f: fn(&(f64, f64)) -> f64| pairs.iter().map(f).sum::<f64>() / n;
    let (a, b) = (mean(|p| p.0), mean(|p| p.1));
    let of = |f: &dyn Fn(f64, f64) -> f64| pairs.iter().map(|p| f(p.0 - a, p.1 - b)).sum::<f64>();
    of(&|x, y| x * y) / (of(&|x, _| x * x) * of(&|_, y| y * y)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factors_do_not_count_and_noise_does() {
        let pairs: Vec<([f32; 3], [f32; 3])> =
            (0..50).map(|i| ([0.01 * i as f32; 3], [0.02 * i as f32, 0.005 * i as f32, 0.01 * i as f32])).collect();
        assert!(scaled_psnr(&pairs) > 100.0, "{}", scaled_psnr(&pairs));
        let off: Vec<_> = pairs.iter().enumerate().map(|(i, (g, w))| (*g, w.map(|v| v + if i % 2 == 0 { 0.1 } else { -0.1 }))).collect();
        assert!((scaled_psnr(&off) - 20.0).abs() < 0.3, "{}", scaled_psnr(&off));
        let line: Vec<(f64, f64)> = (0..20).map(|i| (i as f64, 3.0 - 2.0 * i as f64)).collect();
        assert!((correlation(&line) + 1.0).abs() < 1e-12);
    }
}
