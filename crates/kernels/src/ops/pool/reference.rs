//! Window by window in f64.

use super::Pool;

/// Calls `f(output, places inside the image, places inside the padded image)` for each window of each plane.
fn windows(pool: &Pool, planes: usize, [h, w]: [usize; 2], mut f: impl FnMut(usize, &[usize], usize)) {
    let [oh, ow] = pool.output([h, w]);
    let span = |o: usize, axis: usize, n: usize| {
        let (p, from) = (pool.padding[axis] as i64, (o * pool.stride[axis]) as i64 - pool.padding[axis] as i64);
        let to = (from + pool.kernel[axis] as i64).min(n as i64 + p);
        (from.max(0) as usize..to.min(n as i64).max(0) as usize, (to - from) as usize)
    };
    for o in 0..planes * oh * ow {
        let (plane, (ys, padded_h), (xs, padded_w)) = (o / (oh * ow), span(o / ow % oh, 0, h), span(o % ow, 1, w));
        let inside: Vec<usize> = ys.flat_map(|y| xs.clone().map(move |x| (plane * h + y) * w + x)).collect();
        f(o, &inside, padded_h * padded_w);
    }
}

/// Largest values, and where they are in their plane.
pub fn max(pool: &Pool, planes: usize, from: [usize; 2], x: &[f64]) -> (Vec<f64>, Vec<u32>) {
    let (mut out, mut indices) = (Vec::new(), Vec::new());
    windows(pool, planes, from, |_, inside, _| {
        let mut best = inside[0];
        for i in inside {
            if x[*i] > x[best] {
                best = *i;
            }
        }
        out.push(x[best]);
        indices.push((best % (from[0] * from[1])) as u32);
    });
    (out, indices)
}

/// Gradient of the input of [`max`].
pub fn max_backward(pool: &Pool, planes: usize, from: [usize; 2], x: &[f64], d: &[f64]) -> Vec<f64> {
    let (_, indices) = max(pool, planes, from, x);
    let mut dx = vec![0.0; x.len()];
    let per_plane = indices.len() / planes.max(1);
    for (o, i) in indices.iter().enumerate() {
        dx[o / per_plane * from[0] * from[1] + *i as usize] += d[o];
    }
    dx
}

/// Means.
pub fn average(pool: &Pool, count_padding: bool, planes: usize, from: [usize; 2], x: &[f64]) -> Vec<f64> {
    let mut out = Vec::new();
    windows(pool, planes, from, |_, inside, padded| {
        let count = if count_padding { padded } else { inside.len() };
        out.push(inside.iter().map(|i| x[*i]).sum::<f64>() / count as f64);
    });
    out
}

/// Gradient of the input of [`average`].
pub fn average_backward(pool: &Pool, count_padding: bool, planes: usize, from: [usize; 2], d: &[f64]) -> Vec<f64> {
    let mut dx = vec![0.0; planes * from[0] * from[1]];
    windows(pool, planes, from, |o, inside, padded| {
        let count = if count_padding { padded } else { inside.len() };
        inside.iter().for_each(|i| dx[*i] += d[o] / count as f64);
    });
    dx
}

/// Mean of each plane.
pub fn global_average(places: usize, x: &[f64]) -> Vec<f64> {
    x.chunks(places.max(1)).map(|plane| plane.iter().sum::<f64>() / places as f64).collect()
}
