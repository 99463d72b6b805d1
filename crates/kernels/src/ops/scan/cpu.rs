//! Running sums.

/// Fills `offsets` with exclusive sums of `counts`, one more than there are counts.
pub fn exclusive(counts: &[u32], offsets: &mut Vec<u32>) {
    offsets.clear();
    offsets.push(0);
    let mut total = 0;
    offsets.extend(counts.iter().map(|c| {
        total += c;
        total
    }));
}

/// Inclusive sums within each ray.
pub fn inclusive(offsets: &[u32], x: &[f32], out: &mut [f32]) {
    for w in offsets.windows(2) {
        let mut sum = 0.0;
        for i in w[0] as usize..w[1] as usize {
            sum += x[i];
            out[i] = sum;
        }
    }
}

/// Gradient of [`inclusive`]'s input.
pub fn inclusive_backward(offsets: &[u32], d: &[f32], g: &mut [f32]) {
    for w in offsets.windows(2) {
        let mut sum = 0.0;
        for i in (w[0] as usize..w[1] as usize).rev() {
            sum += d[i];
            g[i] = sum;
        }
    }
}
