//! Materials and their textures at points of surfaces.

use super::bsdf;
use super::geometry::Point;
use super::vector::{V3, along, cross, dot, scale, sub, times, unit};
use diorama_geom::color::linear_from_srgb;
use diorama_geom::model::{Material, Model, Opacity, Texture, Wrap};

/// Materials of a scene.
#[derive(Clone, Debug)]
pub struct Surfaces {
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    /// Linear light of sRGB values.
    pub linear: [f32; 256],
}

/// A surface at a point, as light meets it.
#[derive(Clone, Copy, Debug)]
pub struct Surface {
    pub material: bsdf::Material,
    /// Shading normal, of length 1.
    pub normal: V3,
    pub emission: V3,
    /// Probability that light meets the surface rather than a hole.
    pub opacity: f32,
    /// Share of the light that enters and passes straight through.
    pub transmission: f32,
}

impl Surfaces {
    /// # Panics
    /// When a material refers to a texture that does not exist or is not RGB or RGBA.
    pub fn new(model: &Model) -> Surfaces {
        for t in &model.textures {
            let n = t.image.width * t.image.height;
            assert!(n > 0 && [3, 4].contains(&t.image.channels) && t.image.data.len() == n * t.image.channels, "textures are RGB or RGBA");
        }
        for m in &model.materials {
            for t in [m.base_color_texture, m.metallic_roughness_texture, m.normal_texture, m.emission_texture].into_iter().flatten() {
                assert!(t < model.textures.len(), "material {} refers to texture {t}, which does not exist", m.name);
            }
        }
        Surfaces {
            materials: model.materials.clone(),
            textures: model.textures.clone(),
            linear: std::array::from_fn(|i| linear_from_srgb(i as f32 / 255.0)),
        }
    }

    /// Whether [`Surfaces::at`] reads the tangents of points of a material.
    #[inline(always)]
    pub fn needs_tangent(&self, material: u32) -> bool {
        self.materials[material as usize].normal_texture.is_some()
    }

    /// Whether the material has holes, or lets light pass; only then are `opacity` and `transmission` other than 1 and 0.
    #[inline(always)]
    pub fn at(&self, point: &Point) -> Surface {
        let m = &self.materials[point.material as usize];
        let mut base = m.base_color;
        if let Some(t) = m.base_color_texture {
            let texel = bilinear(&self.textures[t], point.uv, |v| self.linear[v as usize]);
            (0..4).for_each(|k| base[k] *= texel[k]);
        }
        let (mut roughness, mut metallic) = (m.roughness, m.metallic);
        if let Some(t) = m.metallic_roughness_texture {
            let [_, g, b, _] = bilinear(&self.textures[t], point.uv, |v| v as f32 / 255.0);
            (roughness, metallic) = (roughness * g, metallic * b);
        }
        let mut emission = m.emission;
        if let Some(t) = m.emission_texture.filter(|_| emission != [0.0; 3]) {
            let [r, g, b, _] = bilinear(&self.textures[t], point.uv, |v| self.linear[v as usize]);
            emission = times(emission, [r, g, b]);
        }
        Surface {
            material: bsdf::Material {
                base_color: times([base[0], base[1], base[2]], point.color),
                roughness,
                metallic,
                specular: m.specular,
            },
            normal: self.normal(m, point),
            emission,
            opacity: match m.opacity {
                Opacity::Opaque => 1.0,
                Opacity::Cutoff(least) => (base[3] >= least) as u32 as f32,
                Opacity::Blend => base[3].clamp(0.0, 1.0),
            },
            transmission: m.transmission.clamp(0.0, 1.0) * (1.0 - metallic),
        }
    }

    /// The interpolated normal, turned by the normal map.
    #[inline(always)]
    fn normal(&self, m: &Material, point: &Point) -> V3 {
        let n = point.normal;
        let tangent = [point.tangent[0], point.tangent[1], point.tangent[2]];
        let Some(texture) = m.normal_texture.filter(|_| point.tangent[3] != 0.0) else { return n };
        let texel = bilinear(&self.textures[texture], point.uv, |v| v as f32 / 127.5 - 1.0);
        let t = unit(sub(tangent, scale(n, dot(n, tangent))));
        let b = scale(cross(n, t), point.tangent[3].signum());
        unit(along(along(scale(n, texel[2]), m.normal_scale * texel[0], t), m.normal_scale * texel[1], b))
    }
}

/// Values between the four nearest texels, decoded one by one; the fourth channel is 0 to 1, and 1 where there is none.
#[inline(always)]
fn bilinear(texture: &Texture, uv: [f32; 2], decode: impl Fn(u8) -> f32) -> [f32; 4] {
    let image = &texture.image;
    let (x, y) = (uv[0] * image.width as f32 - 0.5, uv[1] * image.height as f32 - 0.5);
    let (left, top) = (x.floor(), y.floor());
    let (fx, fy) = (x - left, y - top);
    let columns = [0, 1].map(|i| wrapped(left as i64 + i, image.width, texture.wrap[0]));
    let rows = [0, 1].map(|i| wrapped(top as i64 + i, image.height, texture.wrap[1]) * image.width);
    let mut sum = [0.0, 0.0, 0.0, if image.channels == 4 { 0.0 } else { 1.0 }];
    for (row, wy) in rows.into_iter().zip([1.0 - fy, fy]) {
        for (column, wx) in columns.into_iter().zip([1.0 - fx, fx]) {
            let texel = &image.data[(row + column) * image.channels..][..image.channels];
            let weight = wx * wy;
            (0..3).for_each(|k| sum[k] += weight * decode(texel[k]));
            if let Some(a) = texel.get(3) {
                sum[3] += weight * *a as f32 / 255.0;
            }
        }
    }
    sum
}

/// Index of a texel that lies within the image.
#[inline(always)]
fn wrapped(i: i64, n: usize, wrap: Wrap) -> usize {
    if (0..n as i64).contains(&i) {
        return i as usize;
    }
    let n = n as i64;
    let i = match wrap {
        Wrap::Clamp => i.clamp(0, n - 1),
        Wrap::Repeat => i.rem_euclid(n),
        Wrap::Mirror => {
            let j = i.rem_euclid(2 * n);
            if j < n { j } else { 2 * n - 1 - j }
        }
    };
    i as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::ImageU8;

    fn texture(wrap: Wrap) -> Texture {
        let data = vec![0, 51, 102, 255, 255, 51, 102, 0];
        Texture { image: ImageU8 { width: 2, height: 1, channels: 4, data }, wrap: [wrap; 2] }
    }

    #[test]
    fn texels_are_blended_and_wrapped() {
        let value = |u: f32, wrap: Wrap| bilinear(&texture(wrap), [u, 0.5], |v| v as f32 / 255.0)[0];
        for (u, wrap, want) in [
            (0.25, Wrap::Clamp, 0.0),
            (0.75, Wrap::Clamp, 1.0),
            (0.5, Wrap::Clamp, 0.5),
            (0.0, Wrap::Clamp, 0.0),
            (0.0, Wrap::Repeat, 0.5),
            (1.25, Wrap::Repeat, 0.0),
            (1.25, Wrap::Mirror, 1.0),
            (-0.75, Wrap::Repeat, 0.0),
            (-0.75, Wrap::Mirror, 1.0),
        ] {
            assert!((value(u, wrap) - want).abs() < 1e-6, "{u} {wrap:?}: {}", value(u, wrap));
        }
        let [_, g, _, a] = bilinear(&texture(Wrap::Clamp), [0.5, 0.5], |v| v as f32 / 255.0);
        assert!((g - 0.2).abs() < 1e-6 && (a - 0.5).abs() < 1e-6);
    }
}
