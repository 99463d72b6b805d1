//! Selects the photographs that differ most: farthest-point sampling over camera position, viewing direction and appearance.

use diorama_geom::capture::{Frame, focus_point};
use diorama_geom::glam::DVec3;
use diorama_geom::{ImageU8, Pose};

/// Edge in pixels of the thumbnails that appearance is compared on.
pub const LOOKS: usize = 8;

/// Appearance of a photograph: RGB values in [0, 1] of a thumbnail of at most `LOOKS` × `LOOKS` pixels.
pub fn looks(image: &ImageU8) -> Vec<f64> {
    let small = image.downsampled(LOOKS.min(image.width), LOOKS.min(image.height));
    let rgb = |p: &[u8]| -> [f64; 3] { std::array::from_fn(|k| p[k.min(p.len() - 1)] as f64 / 255.0) };
    small.data.chunks_exact(small.channels).flat_map(rgb).collect()
}

/// Indices of the `n` frames that differ most, ascending. Starts with the frame of the largest total distance to all others, then adds the
/// frame that is farthest from those chosen.
pub fn diverse(frames: &[Frame], looks: &[Vec<f64>], n: usize) -> Vec<usize> {
    let poses: Vec<Pose> = frames.iter().map(|f| f.world_from_camera).collect();
    let (_, distance) = focus_point(&poses);
    let place: Vec<DVec3> = poses.iter().map(|p| p.translation / distance).collect();
    let view: Vec<DVec3> = poses.iter().map(|p| p.rotation.z_axis).collect();
    let far = |a: usize, b: usize| {
        let l = looks[a].iter().zip(&looks[b]).map(|(x, y)| (x - y).powi(2)).sum::<f64>() / looks[a].len().max(1) as f64;
        ((place[a] - place[b]).length_squared() + (view[a] - view[b]).length_squared() + l).sqrt()
    };
    let all = frames.len();
    let apart = |i: usize| (0..all).map(|j| far(i, j)).sum::<f64>();
    let Some(first) = (0..all).max_by(|a, b| apart(*a).total_cmp(&apart(*b))) else { return Vec::new() };
    let mut chosen = vec![first];
    let mut nearest: Vec<f64> = (0..all).map(|i| far(first, i)).collect();
    while chosen.len() < n.min(all) {
        let next = (0..all).max_by(|a, b| nearest[*a].total_cmp(&nearest[*b])).expect("not empty");
        chosen.push(next);
        (0..all).for_each(|i| nearest[i] = nearest[i].min(far(next, i)));
    }
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::Camera;

    #[test]
    fn one_of_each_place_is_taken_before_a_second() {
        // Five places with six nearly equal photographs each.
        let frames: Vec<Frame> = (0..30)
            .map(|i| {
                let a = (i / 6) as f64 * 1.2 + (i % 6) as f64 * 0.002;
                let pose = Pose::look_at(DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 1.0), DVec3::ZERO, DVec3::Z);
                Frame::new(format!("{i}"), "", Camera::pinhole(8, 8, 1.0), pose)
            })
            .collect();
        let looks = vec![vec![0.5]; 30];
        let chosen = diverse(&frames, &looks, 5);
        assert_eq!(chosen.iter().map(|i| i / 6).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
        assert_eq!(diverse(&frames, &looks, 99).len(), 30);
    }

    #[test]
    fn looks_count_where_poses_are_equal() {
        let pose = Pose::look_at(DVec3::X * 3.0, DVec3::ZERO, DVec3::Z);
        let frames: Vec<Frame> = (0..4).map(|i| Frame::new(format!("{i}"), "", Camera::pinhole(8, 8, 1.0), pose)).collect();
        let image = |v: u8| looks(&ImageU8 { width: 16, height: 16, channels: 3, data: vec![v; 16 * 16 * 3] });
        let chosen = diverse(&frames, &[image(10), image(12), image(240), image(11)], 2);
        assert!(chosen.contains(&2), "{chosen:?}");
    }
}
