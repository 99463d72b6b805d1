//! Third stage: how it begins. The mesh is kept; shadows and light between its surfaces are traced; the light is found anew, and what it was
//! mistaken for is taken out of the base color.

use super::albedo_entropy::{self, Sighting};
use super::capture::ObjectCapture;
use super::config::{CHANNELS, Config};
use super::gloss::{self, Gloss};
use super::metal::{Classifier, Metal};
use super::probe::{self, Probe};
use super::surroundings::Surroundings;
use super::textured::Textured;
use super::transport::{dot, unit};
use diorama_geom::capture::Split;
use diorama_geom::mesh::{cross, sub};
use diorama_kernels::ops::vertex_normals;
use diorama_mesh::bake::{self, Texels};

/// Roughness to begin with.
const ROUGHNESS: f32 = 0.5;
/// How often light and gloss are found in turns, and the least share of a color that is not gloss.
const ROUNDS: usize = 2;
const LEFT: f32 = 0.1;
/// Largest base color to begin with, and least light.
const BRIGHTEST: f32 = 0.95;
const DARK: f32 = 1e-3;
/// Share of the light that may fall on base colors that are too bright, as they are wrong.
const WRONG: f32 = 0.05;
/// Least light of the second stage that the third begins with, over its mean.
const DIMMEST: f32 = 0.1;

/// What the mesh casts onto itself.
pub fn surroundings(m: &Textured, config: &Config) -> Surroundings {
    let normals = vertex_normals::cpu::forward(&m.layout.faces, m.places());
    Surroundings::new(m.places(), &normals, &m.layout.faces, config.seed, config.run.samples)
}

/// Traces the surroundings, finds the light unless it is given, and divides it out.
pub fn begin(m: &mut Textured, config: &Config, capture: &ObjectCapture, probe: &mut Probe) {
    let around = surroundings(m, config);
    probe.update();
    let size = config.material.texture;
    let sent = Sent::of(m, size, probe);
    let tells = Classifier::of(m.texels.values.as_chunks().0);
    let (gloss, of_metal) = find_light(m, config, capture, (&around, probe, &metal_of(m, &tells)));
    let roughness = gloss.as_ref().map_or(ROUGHNESS, |g| g.roughness);
    let mut mirrored = gloss.map_or_else(|| vec![[0.0; 3]; m.places().len()], |g| g.mirrored);
    let kept: Vec<([f32; CHANNELS], bool)> =
        m.texels.values.as_chunks().0.iter().map(|t| (*t, of_metal.is_some() && tells.is_metal(t))).collect();
    let mut of_metal = of_metal.unwrap_or([1.0; 3]);
    if !probe.group.frozen {
        // No surface sends more than it receives.
        let by = excess(&sent.colors(m, &around, probe, &mirrored));
        probe.scale(by);
        (0..3).for_each(|k| mirrored.iter_mut().for_each(|m| m[k] *= by[k]));
        (0..3).for_each(|k| of_metal[k] /= by[k]);
    }
    // Two rounds: light between surfaces depends on their colors.
    for _ in 0..2 {
        let colors: Vec<[f32; 3]> = sent.colors(m, &around, probe, &mirrored).iter().map(|(c, _)| c.map(|c| c.min(BRIGHTEST))).collect();
        let spread = bake::spread(&sent.texels, &colors, size);
        for ((t, c), (before, is_metal)) in m.texels.values.as_chunks_mut::<CHANNELS>().0.iter_mut().zip(&spread).zip(&kept) {
            let color = if *is_metal { std::array::from_fn(|k| (of_metal[k] * before[k]).min(BRIGHTEST)) } else { *c };
            t[..3].copy_from_slice(&color);
            t[3..6].copy_from_slice(&if *is_metal { [0.0, before[4], 1.0] } else { [0.0, roughness, 0.0] });
        }
    }
    m.forget_steps();
    m.surroundings = Some(Box::new(around));
}

/// What texels of the second stage send diffusely, in its light.
struct Sent {
    texels: Texels,
    colors: Vec<[f32; 3]>,
}

impl Sent {
    fn of(m: &Textured, size: usize, probe: &Probe) -> Sent {
        let mut flat = m.mesh();
        flat.normals = m.smooth_normals();
        let texels = bake::texels(&flat, size);
        let light = probe.diffuse(texels.normals.as_flattened());
        let color = |(i, light): (&u32, &[f32; 3])| {
            let t = &m.texels.values[*i as usize * CHANNELS..][..CHANNELS];
            std::array::from_fn(|k| t[k] * (1.0 - t[5]) * (1.0 - t[3]) * light[k])
        };
        let colors = texels.index.iter().zip(light.as_chunks::<3>().0).map(color).collect();
        Sent { texels, colors }
    }

    /// Base colors of the texels, not bounded, and the light on them, when vertices mirror some of what is sent `[V]`.
    fn colors(&self, m: &Textured, around: &Surroundings, probe: &Probe, mirrored: &[[f32; 3]]) -> Vec<([f32; 3], [f32; 3])> {
        let lit = around.light(probe, &m.vertex_colors(&m.drawn()));
        let color = |(i, sent): (usize, &[f32; 3])| {
            let corners = m.layout.faces[self.texels.face[i] as usize].map(|v| v as usize);
            let weights = place(self.texels.positions[i], corners.map(|v| m.places()[v]));
            let mix = |of: &dyn Fn(usize) -> f32| (0..3).map(|c| weights[c] * of(corners[c])).sum::<f32>();
            let light: [f32; 3] = std::array::from_fn(|k| mix(&|v| lit.diffuse(v)[k]).max(DARK));
            (std::array::from_fn(|k| (sent[k] - mix(&|v| mirrored[v][k])).max(LEFT * sent[k]) / light[k]), light)
        };
        self.colors.iter().enumerate().map(color).collect()
    }
}

/// Factors of the light by channel under which all but a few of the base colors, given with the light on them, are possible.
fn excess(colors: &[([f32; 3], [f32; 3])]) -> [f32; 3] {
    [0, 1, 2].map(|k| {
        let mut all: Vec<(f32, f32)> = colors.iter().map(|(c, light)| (c[k], light[k])).collect();
        all.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut left = WRONG * all.iter().map(|c| c.1).sum::<f32>();
        let brightest = all.iter().find(|c| {
            left -= c.1;
            left < 0.0
        });
        brightest.map_or(1.0, |c| (c.0 / BRIGHTEST).max(1.0))
    })
}

/// What the second stage classifies as metal.
fn metal_of(m: &Textured, tells: &Classifier) -> Metal {
    let values = m.at_vertices(&m.drawn());
    let texels = || values.as_chunks::<CHANNELS>().0.iter();
    Metal {
        is_metal: texels().map(|t| tells.is_metal(t)).collect(),
        colors: texels().map(|t| [t[0], t[1], t[2]]).collect(),
        roughness: texels().map(|t| t[4]).collect(),
    }
}

/// Finds the light, beginning with that of the second stage; what gloss tells of its brightness, and the factor of the metals' base
/// colors, where enough of them is seen.
fn find_light(
    m: &Textured,
    config: &Config,
    capture: &ObjectCapture,
    (around, probe, metal): (&Surroundings, &mut Probe, &Metal),
) -> (Option<Gloss>, Option<[f32; 3]>) {
    let normals: Vec<[f32; 3]> = vertex_normals::cpu::forward(&m.layout.faces, m.places()).into_iter().map(unit).collect();
    let photos: Vec<_> = capture.indices(Split::Train).into_iter().map(|i| &capture.photos[i]).collect();
    let at = (m.places(), &normals[..]);
    let all = albedo_entropy::sightings(&photos, at, &around.transport);
    // Metal has neither diffuse colors nor the gloss of what is no metal.
    let (metals, sightings): (Vec<Vec<Sighting>>, Vec<Vec<Sighting>>) =
        all.into_iter().zip(&metal.is_metal).map(|(s, m)| if *m { (s, Vec::new()) } else { (Vec::new(), s) }).unzip();
    let of_metals = gloss::rows(&around.transport, &metals, at);
    let factor = |probe: &Probe| metal.factor(probe, &of_metals);
    if probe.group.frozen {
        let mut gloss = gloss::fit(probe, &around.transport, &sightings, at);
        // The light is as bright as it is.
        if let Some(g) = &mut gloss {
            g.mirrored.iter_mut().for_each(|m| (0..3).for_each(|k| m[k] /= g.scale[k]));
        }
        return (gloss, factor(probe));
    }
    // About 1, and nowhere so dark that it could not be brightened.
    let mean = probe.group.values.iter().sum::<f32>() / probe.group.values.len() as f32;
    let learned: Vec<f32> = probe.group.values.iter().map(|v| (v / mean.max(DARK)).max(DIMMEST)).collect();
    let first = probe::coarse(&learned, around.transport.edge);
    let mut observed = albedo_entropy::observed(&sightings);
    let mut gloss = None;
    for _ in 0..ROUNDS {
        let coarse = albedo_entropy::estimate(&around.transport, &first, &observed, m.places(), config.seed);
        let factor: Vec<[f32; 3]> = coarse.iter().zip(&first).map(|(c, f)| std::array::from_fn(|k| c[k] / f[k])).collect();
        probe.set_scaled(&learned, &factor, config.optim.traced_light_rate);
        gloss = gloss::fit(probe, &around.transport, &sightings, at);
        let Some(g) = &gloss else { break };
        probe.scale(g.scale);
        observed = albedo_entropy::observed(&sightings);
        for (o, mirrored) in observed.iter_mut().zip(&g.mirrored) {
            *o = o.map(|c| std::array::from_fn(|k| (c[k] - mirrored[k]).max(LEFT * c[k])));
        }
    }
    // No metal mirrors more than it receives.
    let Some(of_metal) = factor(probe) else { return (gloss, None) };
    let by = (metal.brightest() * of_metal[0].max(of_metal[1]).max(of_metal[2]) / BRIGHTEST).max(1.0);
    if by > 1.0 {
        probe.scale([by; 3]);
        gloss.iter_mut().for_each(|g| g.mirrored.as_flattened_mut().iter_mut().for_each(|m| *m *= by));
    }
    (gloss, Some(of_metal.map(|f| f / by)))
}

/// Weights of a triangle's corners at a point of it.
fn place(p: [f32; 3], [a, b, c]: [[f32; 3]; 3]) -> [f32; 3] {
    let (ab, ac, ap) = (sub(b, a), sub(c, a), sub(p, a));
    let n = cross(ab, ac);
    let area = dot(n, n).max(1e-20);
    let (v, w) = (dot(cross(ap, ac), n) / area, dot(cross(ab, ap), n) / area);
    let [v, w] = [v.clamp(0.0, 1.0), w.clamp(0.0, 1.0)];
    [(1.0 - v - w).max(0.0), v, w]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_becomes_as_bright_as_the_brightest_color_needs() {
        // Some light falls on noise, much of the surface is in the dark.
        let lit = |c: [f32; 3]| (c, [1.0; 3]);
        let mut colors: Vec<_> = (0..1000).map(|i| lit([0.5 + (i / 100) as f32 / 10.0, 0.3, 0.1])).collect();
        colors.extend((0..30).map(|_| lit([40.0; 3])));
        colors.extend((0..500).map(|_| ([9.0; 3], [1e-3; 3])));
        let by = excess(&colors);
        assert!((by[0] - 1.4 / BRIGHTEST).abs() < 0.01 && by[1..] == [1.0; 2], "{by:?}");
        assert_eq!(excess(&[]), [1.0; 3]);
    }
}
