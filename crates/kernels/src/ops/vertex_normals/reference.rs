//! Plain loops in f64.

type Point = [f64; 3];

fn sub(a: Point, b: Point) -> Point {
    std::array::from_fn(|k| a[k] - b[k])
}

fn cross(a: Point, b: Point) -> Point {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn sums(faces: &[[u32; 3]], positions: &[Point]) -> Vec<Point> {
    let mut sums = vec![[0.0; 3]; positions.len()];
    for f in faces {
        let [a, b, c] = f.map(|i| positions[i as usize]);
        let n = cross(sub(b, a), sub(c, a));
        f.iter().for_each(|i| (0..3).for_each(|k| sums[*i as usize][k] += n[k]));
    }
    sums
}

fn length(v: Point) -> f64 {
    v.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Normals `[V, 3]`.
pub fn forward(faces: &[[u32; 3]], positions: &[Point]) -> Vec<Point> {
    let unit = |n: Point| if length(n) > super::LEAST as f64 { n.map(|v| v / length(n)) } else { [0.0, 0.0, 1.0] };
    sums(faces, positions).into_iter().map(unit).collect()
}

/// Gradient of positions for the gradient `d` of normals.
pub fn backward(faces: &[[u32; 3]], positions: &[Point], d: &[Point]) -> Vec<Point> {
    let d_sums: Vec<Point> = sums(faces, positions)
        .into_iter()
        .zip(d)
        .map(|(n, d)| {
            let l = length(n);
            if l <= super::LEAST as f64 {
                return [0.0; 3];
            }
            let along = (0..3).map(|k| n[k] * d[k]).sum::<f64>() / (l * l);
            std::array::from_fn(|k| (d[k] - along * n[k]) / l)
        })
        .collect();
    let mut out = vec![[0.0; 3]; positions.len()];
    for f in faces {
        let [a, b, c] = f.map(|i| positions[i as usize]);
        let (p, q) = (sub(b, a), sub(c, a));
        let g: Point = std::array::from_fn(|k| f.iter().map(|i| d_sums[*i as usize][k]).sum());
        // n = p × q: dp = q × g, dq = g × p.
        let (dp, dq) = (cross(q, g), cross(g, p));
        for k in 0..3 {
            out[f[0] as usize][k] -= dp[k] + dq[k];
            out[f[1] as usize][k] += dp[k];
            out[f[2] as usize][k] += dq[k];
        }
    }
    out
}
