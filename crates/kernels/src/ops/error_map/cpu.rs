//! Rays are mixed in one after the other.

use super::{CELLS, ErrorMap, KEPT, cell_at};

impl ErrorMap {
    /// A map of equal errors.
    pub fn new(images: usize) -> Self {
        let errors = vec![1.0; images * CELLS * CELLS];
        let mut map = ErrorMap { drawn: errors.clone(), errors, cdf: Vec::new() };
        map.rebuild();
        map
    }

    /// Mixes a ray's squared error into its cell; `u` and `v` are shares of the image's width and height.
    pub fn record(&mut self, image: usize, u: f32, v: f32, error: f32) {
        let e = &mut self.errors[cell_at(image, u, v)];
        *e = KEPT * *e + 0.1 * error;
    }

    /// Makes draws go by the present errors.
    pub fn refresh(&mut self) {
        self.drawn.copy_from_slice(&self.errors);
        self.rebuild();
    }

    /// Recomputes the distribution from `drawn`.
    pub fn rebuild(&mut self) {
        let mut sum = 0.0f64;
        self.cdf.clear();
        for e in &self.drawn {
            sum += (*e as f64).sqrt();
            self.cdf.push(sum as f32);
        }
    }

    /// The cell at share `x` of the distribution.
    pub fn cell(&self, x: f32) -> usize {
        let total = self.cdf.last().copied().unwrap_or(0.0);
        self.cdf.partition_point(|c| *c < x * total).min(self.errors.len() - 1)
    }

    #[cfg(test)]
    pub(crate) fn cdf(&self) -> &[f32] {
        &self.cdf
    }
}
