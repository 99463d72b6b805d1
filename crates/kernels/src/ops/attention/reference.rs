//! Reference attention: query by query, in f64.

use super::Attention;

/// Weights of one query: (softmax, logarithm of the sum of exponentials).
fn weights(a: &Attention, batch: usize, query: usize, q: &[f64], k: &[f64]) -> (Vec<f64>, f64) {
    let d = a.width;
    let keys = if a.causal { (query + 1).min(a.keys) } else { a.keys };
    let q = &q[(batch * a.queries + query) * d..][..d];
    let scores: Vec<f64> =
        (0..keys).map(|j| a.scale as f64 * q.iter().zip(&k[(batch * a.keys + j) * d..]).map(|(a, b)| a * b).sum::<f64>()).collect();
    let most = scores.iter().fold(f64::NEG_INFINITY, |a, b| a.max(*b));
    let log_sum = most + scores.iter().map(|s| (s - most).exp()).sum::<f64>().ln();
    (scores.iter().map(|s| (s - log_sum).exp()).collect(), log_sum)
}

/// Output `[batch, queries, width]`, and the logarithm of each query's sum of exponentials, `[batch, queries]`.
pub fn forward(a: &Attention, q: &[f64], k: &[f64], v: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut out, mut log_sums) = (vec![0.0; q.len()], Vec::new());
    for batch in 0..a.batch {
        for query in 0..a.queries {
            let (weights, log_sum) = weights(a, batch, query, q, k);
            log_sums.push(log_sum);
            for (j, w) in weights.iter().enumerate() {
                for c in 0..a.width {
                    out[(batch * a.queries + query) * a.width + c] += w * v[(batch * a.keys + j) * a.width + c];
                }
            }
        }
    }
    (out, log_sums)
}

/// Gradients of q, k and v, given the gradient `d_out` of the output.
pub fn backward(a: &Attention, q: &[f64], k: &[f64], v: &[f64], d_out: &[f64]) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let (mut dq, mut dk, mut dv) = (vec![0.0; q.len()], vec![0.0; k.len()], vec![0.0; v.len()]);
    for batch in 0..a.batch {
        for query in 0..a.queries {
            let (weights, _) = weights(a, batch, query, q, k);
            let own = (batch * a.queries + query) * a.width;
            let d = &d_out[own..own + a.width];
            let along: Vec<f64> =
                (0..weights.len()).map(|j| d.iter().zip(&v[(batch * a.keys + j) * a.width..]).map(|(a, b)| a * b).sum()).collect();
            let mean: f64 = weights.iter().zip(&along).map(|(w, g)| w * g).sum();
            for (j, w) in weights.iter().enumerate() {
                let (key, g) = ((batch * a.keys + j) * a.width, w * (along[j] - mean) * a.scale as f64);
                for c in 0..a.width {
                    dv[key + c] += w * d[c];
                    dq[own + c] += g * k[key + c];
                    dk[key + c] += g * q[own + c];
                }
            }
        }
    }
    (dq, dk, dv)
}
