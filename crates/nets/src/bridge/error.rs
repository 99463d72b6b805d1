//! What is wrong with a call of an op, found before anything runs.

/// A call of an op that cannot be carried out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum OpError {
    #[error("{op}: {what} has shape {got:?}, expected {expected}")]
    Shape { op: &'static str, what: &'static str, got: Vec<usize>, expected: String },
    #[error("{op} takes {expected} tensors, got {got}")]
    Inputs { op: &'static str, expected: String, got: usize },
    #[error("{op}: {message}")]
    Settings { op: &'static str, message: String },
    #[error("{op}: input {index} holds {got} numbers, expected F32")]
    Type { op: &'static str, index: usize, got: String },
    #[error("{op}: input {index} is on another device than input 0")]
    Devices { op: &'static str, index: usize },
    #[error("{op} has no kernels for this device; move its inputs to the CPU")]
    NoKernels { op: &'static str },
}

impl OpError {
    /// A wrong shape, with the expected one in words.
    pub fn shape(op: &'static str, what: &'static str, got: &[usize], expected: impl Into<String>) -> Self {
        OpError::Shape { op, what, got: got.to_vec(), expected: expected.into() }
    }

    /// Settings that contradict each other or the shapes.
    pub fn settings(op: &'static str, message: impl Into<String>) -> Self {
        OpError::Settings { op, message: message.into() }
    }
}

/// Checks that an op got `expected` inputs.
pub fn expect_inputs(op: &'static str, shapes: &[&[usize]], expected: usize) -> Result<(), OpError> {
    if shapes.len() == expected {
        return Ok(());
    }
    Err(OpError::Inputs { op, expected: expected.to_string(), got: shapes.len() })
}

/// Checks one shape against a pattern, in which `None` admits any extent.
pub fn expect_shape(op: &'static str, what: &'static str, got: &[usize], expected: &[Option<usize>]) -> Result<(), OpError> {
    let fits = got.len() == expected.len() && got.iter().zip(expected).all(|(g, e)| e.is_none_or(|e| e == *g));
    if fits {
        return Ok(());
    }
    let words: Vec<String> = expected.iter().map(|e| e.map_or("any".to_string(), |e| e.to_string())).collect();
    Err(OpError::shape(op, what, got, format!("[{}]", words.join(", "))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_shape_names_op_input_and_expectation() {
        assert_eq!(expect_shape("linear", "x", &[3, 4], &[None, Some(4)]), Ok(()));
        let e = expect_shape("linear", "x", &[3, 4], &[None, Some(5)]).unwrap_err();
        assert_eq!(e.to_string(), "linear: x has shape [3, 4], expected [any, 5]");
        assert!(expect_shape("linear", "x", &[3, 4, 1], &[None, Some(4)]).is_err());
        assert_eq!(expect_inputs("scan", &[], 1).unwrap_err().to_string(), "scan takes 1 tensors, got 0");
    }
}
