//! Counts as options have them.

/// A whole number, with k for thousands and M for millions.
pub fn count(text: &str) -> Option<usize> {
    let (number, factor) = match text.char_indices().last()? {
        (at, 'k' | 'K') => (&text[..at], 1e3),
        (at, 'm' | 'M') => (&text[..at], 1e6),
        _ => (text, 1.0),
    };
    let value = number.parse::<f64>().ok().filter(|v| v.is_finite() && *v >= 0.0)? * factor;
    (value <= u32::MAX as f64).then_some(value.round() as usize)
}

#[cfg(test)]
mod tests {
    use super::count;

    #[test]
    fn counts_have_suffixes() {
        assert_eq!(["500k", "1.5M", "20000", "0"].map(count), [Some(500_000), Some(1_500_000), Some(20_000), Some(0)]);
        assert_eq!(["", "k", "-3", "1e99", "five"].map(count), [None; 5]);
    }
}
