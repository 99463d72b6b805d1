//! Transfer functions between sRGB-encoded and linear light (IEC 61966-2-1).

/// Decodes one sRGB value in [0, 1] to linear light.
pub fn linear_from_srgb(srgb: f32) -> f32 {
    if srgb <= 0.04045 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
}

/// Encodes one linear value to sRGB; values above 1 follow the same curve.
pub fn srgb_from_linear(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// Shares of linear red, green and blue in luminance (ITU-R BT.709).
pub const LUMINANCE: [f32; 3] = [0.2126, 0.7152, 0.0722];

/// Luminance of a linear color.
pub fn luminance(rgb: [f64; 3]) -> f64 {
    0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]
}

/// Quantizes a color value in [0, 1] to 8 bits, rounding to nearest and clamping.
pub fn u8_from_unit(value: f32) -> u8 {
    (value * 255.0 + 0.5).clamp(0.0, 255.0) as u8
}

/// Quantizes a value in [0, 1] to 16 bits, rounding to nearest and clamping.
pub fn u16_from_unit(value: f32) -> u16 {
    (value * 65535.0 + 0.5).clamp(0.0, 65535.0) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_round_trip() {
        for i in 0..=255 {
            let v = i as f32 / 255.0;
            assert!((srgb_from_linear(linear_from_srgb(v)) - v).abs() < 1e-5);
        }
    }

    #[test]
    fn quantisation_rounds_and_clamps() {
        assert_eq!([u8_from_unit(-1.0), u8_from_unit(0.5), u8_from_unit(2.0)], [0, 128, 255]);
    }
}
