//! Numbers with a name and a shape: how weights travel between the files of one room and the networks of another.

/// A named array, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedArray {
    pub name: String,
    pub shape: Vec<usize>,
    pub values: Vec<f32>,
}

impl NamedArray {
    /// # Panics
    /// When the shape asks for another count of values.
    pub fn new(name: impl Into<String>, shape: &[usize], values: Vec<f32>) -> Self {
        assert_eq!(values.len(), shape.iter().product::<usize>(), "as many values as the shape says");
        NamedArray { name: name.into(), shape: shape.to_vec(), values }
    }
}
