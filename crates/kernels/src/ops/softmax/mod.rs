//! `softmax` and `log softmax` of rows, and the cross entropy of logits with a class per row, with label smoothing
//! (Szegedy et al. 2016). Rows are shifted by their largest value, so that no exponential overflows.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// What a cross entropy compares with.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    /// Class of each row, `[M]`.
    pub classes: &'a [i64],
    /// Share ε of the target that is spread over all classes, in 0..=1.
    pub smoothing: f32,
    /// Rows of this class count as absent.
    pub ignored: i64,
}

impl Targets<'_> {
    /// Rows that count; the mean loss divides by it.
    pub fn counted(&self) -> usize {
        self.classes.iter().filter(|c| **c != self.ignored).count()
    }
}
