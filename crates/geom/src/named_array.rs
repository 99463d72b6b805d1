//! Named arrays: weights read from files, before they are loaded into networks.

/// A named array in row-major order.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedArray {
    pub name: String,
    pub shape: Vec<usize>,
    pub values: Vec<f32>,
}

impl NamedArray {
    /// # Panics
    /// If the number of values differs from the product of the shape.
    pub fn new(name: impl Into<String>, shape: &[usize], values: Vec<f32>) -> Self {
        assert_eq!(values.len(), shape.iter().product::<usize>(), "as many values as the shape says");
        NamedArray { name: name.into(), shape: shape.to_vec(), values }
    }
}
