//! Removes the noise of path-traced pictures by edge-avoiding wavelets.
//!
//! Dammertz et al. 2010, "Edge-Avoiding À-Trous Wavelet Transform for fast Global Illumination Filtering": five passes of a 5 × 5 kernel
//! whose taps are `2^pass` pixels apart. The picture divided by the albedo is filtered. The weight of a tap falls with the difference
//! of normals, albedo, opacity and depth, and with that of luminance relative to the noise, which is filtered along (Schied et al. 2017).

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Passes; the last one has taps 16 pixels apart.
const PASSES: usize = 5;
/// B3 spline by distance from the center.
const SPLINE: [f32; 3] = [3.0 / 8.0, 1.0 / 4.0, 1.0 / 16.0];
/// Scales at which differences of normals, albedo and opacity end a weight.
const NORMAL: f32 = 0.12;
const ALBEDO: f32 = 0.05;
const OPACITY: f32 = 0.1;
/// Depth that differs by this share of itself per pixel of distance.
const DEPTH: f32 = 0.02;
/// Standard deviations of luminance.
const NOISE: f32 = 3.0;
/// Added to the albedo before the division.
const DARK: f32 = 0.01;

/// What guides the filter at a pixel, and what is filtered: 8 numbers of guides, then light over albedo and the variance of its luminance.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Texel<F> {
    normal: [F; 3],
    albedo: [F; 3],
    opacity: F,
    depth: F,
    light: [F; 3],
    variance: F,
}
