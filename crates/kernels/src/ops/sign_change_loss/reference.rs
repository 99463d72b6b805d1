//! Edge by edge in f64, with the logarithms written out.

/// Value and gradient for unique `edges` and distances `s`.
pub fn loss(edges: &[[u32; 2]], s: &[f64]) -> (f64, Vec<f64>) {
    let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
    let entropy = |x: f64, y: f64| -(y * sigmoid(x).ln() + (1.0 - y) * (1.0 - sigmoid(x)).ln());
    let sign = |x: f64| if x > 0.0 { 1.0 } else { 0.0 };
    let cut: Vec<[usize; 2]> = edges.iter().map(|e| e.map(|i| i as usize)).filter(|[i, j]| sign(s[*i]) != sign(s[*j])).collect();
    let (mut value, mut gradient) = (0.0, vec![0.0; s.len()]);
    let n = cut.len().max(1) as f64;
    for [i, j] in cut {
        for (own, other) in [(i, j), (j, i)] {
            value += entropy(s[own], sign(s[other])) / n;
            gradient[own] += (sigmoid(s[own]) - sign(s[other])) / n;
        }
    }
    (value, gradient)
}
