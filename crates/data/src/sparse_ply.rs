//! Sparse points as a PLY that any reader of point clouds opens. It also holds data that other programs skip: each point's reprojection
//! error, and after the points an element `observation` with pairs of point and frame. Comments name the frames.

use crate::atomic;
use crate::error::{DataError, Result};
use diorama_geom::SparsePoint;
use diorama_geom::capture::Frame;
use std::collections::HashMap;
use std::io::Write;
use std::path::Path;

/// Properties of a point, in 19 bytes.
const POINT: &str = "property float x\nproperty float y\nproperty float z\n\
property uchar red\nproperty uchar green\nproperty uchar blue\nproperty float error\n";
const POINT_BYTES: usize = 19;
/// Byte offset of a point's error.
const ERROR_AT: usize = 15;
const OBSERVATION: &str = "property uint point\nproperty uint frame\n";
const OBSERVATION_BYTES: usize = 8;
/// Start of a comment that names a frame's image.
const FRAME: &str = "comment frame ";

/// Writes points, whose frames are indices into `frames`; images are named relative to `root`.
pub fn write(path: &Path, points: &[SparsePoint], frames: &[Frame], root: &Path) -> Result<()> {
    atomic::write_with(path, |w| {
        write!(w, "ply\nformat binary_little_endian 1.0\ncomment diorama {}; z up\n", env!("CARGO_PKG_VERSION"))?;
        for f in frames {
            writeln!(w, "{FRAME}{}", f.image.strip_prefix(root).unwrap_or(&f.image).display().to_string().replace('\\', "/"))?;
        }
        let observations: usize = points.iter().map(|p| p.frames.len()).sum();
        write!(w, "element vertex {}\n{POINT}element observation {observations}\n{OBSERVATION}end_header\n", points.len())?;
        for p in points {
            p.position.as_vec3().to_array().iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))?;
            w.write_all(&p.color)?;
            w.write_all(&p.error.to_le_bytes())?;
        }
        for (i, p) in points.iter().enumerate() {
            for f in &p.frames {
                w.write_all(&(i as u32).to_le_bytes())?;
                w.write_all(&f.to_le_bytes())?;
            }
        }
        Ok(())
    })
}

/// Adds errors and frames to points that were read from the file's vertices, in their order. Files not written by [`write()`] have
/// neither. Observations by images (relative to `root`) that are not among `frames` are dropped.
///
/// # Errors
/// If the file ends early, or a pair names a point or an image that does not exist.
pub fn observe(path: &Path, root: &Path, data: &[u8], frames: &[Frame], points: &mut [SparsePoint]) -> Result<()> {
    let Some((names, [n, pairs], body)) = head(data) else { return Ok(()) };
    let count =
        |text: &str| text.parse().map_err(|_| DataError::input(path, format!("element: {text:?} is not a count; run prepare again")));
    let (n, pairs): (usize, usize) = (count(n)?, count(pairs)?);
    let end_of = |from: usize, n: usize, bytes: usize| n.checked_mul(bytes)?.checked_add(from).filter(|end| *end <= data.len());
    let ends = end_of(body, n, POINT_BYTES).and_then(|v| Some((v, end_of(v, pairs, OBSERVATION_BYTES)?)));
    let Some((vertices, end)) = ends else {
        return Err(DataError::input(path, format!("ends early: it claims {n} points and {pairs} observations; run prepare again")));
    };
    if n != points.len() {
        return Err(DataError::input(path, format!("{} of {n} points are finite; run prepare again", points.len())));
    }
    let number = |b: &[u8]| u32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    for (p, row) in points.iter_mut().zip(data[body..vertices].chunks_exact(POINT_BYTES)) {
        p.error = f32::from_bits(number(&row[ERROR_AT..]));
    }
    let frame: HashMap<_, u32> = frames.iter().enumerate().map(|(i, f)| (f.image.clone(), i as u32)).collect();
    let frame_of: Vec<Option<u32>> = names.iter().map(|name| frame.get(&root.join(name)).copied()).collect();
    for pair in data[vertices..end].chunks_exact(OBSERVATION_BYTES) {
        let (point, name) = (number(pair) as usize, number(&pair[4..]) as usize);
        let (Some(p), Some(frame)) = (points.get_mut(point), frame_of.get(name)) else {
            return Err(DataError::input(
                path,
                format!("point {point} is seen by image {name}, one of which does not exist; run prepare again"),
            ));
        };
        p.frames.extend(frame);
    }
    points.iter_mut().for_each(|p| {
        p.frames.sort_unstable();
        p.frames.dedup();
    });
    Ok(())
}

/// The images, the text with the counts, and the position of the points; `None` if the header was not written by [`write()`].
fn head(data: &[u8]) -> Option<(Vec<&str>, [&str; 2], usize)> {
    let mark = b"end_header\n";
    let body = data.windows(mark.len()).position(|w| w == mark)? + mark.len();
    let text = std::str::from_utf8(&data[..body]).ok()?;
    text.starts_with("ply\nformat binary_little_endian 1.0\n").then_some(())?;
    let names = text.lines().filter_map(|l| l.strip_prefix(FRAME)).collect();
    let (_, elements) = text.split_once("element vertex ")?;
    let (points, rest) = elements.split_once('\n')?;
    let (observations, rest) = rest.strip_prefix(POINT)?.strip_prefix("element observation ")?.split_once('\n')?;
    (rest.strip_prefix(OBSERVATION)? == "end_header\n").then_some(())?;
    Some((names, [points, observations], body))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::glam::DVec3;
    use diorama_geom::{Camera, Pose};

    fn frames(names: &[&str]) -> Vec<Frame> {
        names.iter().map(|n| Frame::new(*n, Path::new("/home/capture").join(n), Camera::pinhole(8, 8, 1.0), Pose::IDENTITY)).collect()
    }

    fn points() -> Vec<SparsePoint> {
        let point = |x: f64, error: f32, frames: &[u32]| SparsePoint {
            position: DVec3::new(x, 0.5, -2.0),
            color: [1, 2, 3],
            error,
            frames: frames.to_vec(),
        };
        vec![point(0.25, 0.5, &[0, 2]), point(7.0, 1.25, &[]), point(-1.0, 0.75, &[1, 2])]
    }

    #[test]
    fn other_programs_read_the_points_and_we_read_who_sees_them() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("points.ply");
        let all = frames(&["images/a.jpg", "images/b c.jpg", "images/c.jpg"]);
        let root = Path::new("/home/capture");
        write(&file, &points(), &all, root).unwrap();
        let cloud = crate::splat_ply::read(&file).unwrap();
        assert_eq!((cloud.len(), cloud.positions[2]), (3, [-1.0, 0.5, -2.0]));
        let data = std::fs::read(&file).unwrap();
        let bare = || points().into_iter().map(|p| SparsePoint { error: 0.0, frames: Vec::new(), ..p }).collect::<Vec<_>>();
        let mut read = bare();
        observe(&file, root, &data, &all, &mut read).unwrap();
        assert_eq!(read, points());

        // Frames in another order, one of them missing.
        let mut fewer = bare();
        observe(&file, root, &data, &frames(&["images/c.jpg", "images/a.jpg"]), &mut fewer).unwrap();
        assert_eq!(fewer.iter().map(|p| p.frames.clone()).collect::<Vec<_>>(), [vec![0, 1], vec![], vec![0]]);

        let e = observe(&file, root, &data[..data.len() - 1], &all, &mut bare()).unwrap_err().to_string();
        assert!(e.contains("points.ply") && e.contains("ends early"), "{e}");
        let mut wrong = data.clone();
        let last = wrong.len() - 4;
        wrong[last] = 9;
        let e = observe(&file, root, &wrong, &all, &mut bare()).unwrap_err().to_string();
        assert!(e.contains("image 9"), "{e}");

        // Counts whose sum overflows.
        let text = String::from_utf8_lossy(&data[..400]).replace("observation 4", "observation 2305843009213693951");
        let e = observe(&file, root, text.as_bytes(), &all, &mut bare()).unwrap_err().to_string();
        assert!(e.contains("2305843009213693951 observations"), "{e}");
        let text = String::from_utf8_lossy(&data[..400]).replace("observation 4", "observation four");
        let e = observe(&file, root, text.as_bytes(), &all, &mut bare()).unwrap_err().to_string();
        assert!(e.contains("\"four\" is not a count"), "{e}");
        let e = observe(&file, root, &data, &all, &mut bare()[..2]).unwrap_err().to_string();
        assert!(e.contains("2 of 3 points are finite"), "{e}");
    }

    #[test]
    fn files_of_others_say_nothing() {
        let ours_as_text = format!("ply\nformat ascii 1.0\nelement vertex 3\n{POINT}element observation 1\n{OBSERVATION}end_header\n0 0\n");
        for text in ["ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n", &ours_as_text] {
            let mut p = points();
            observe(Path::new("a.ply"), Path::new(""), text.as_bytes(), &[], &mut p).unwrap();
            assert_eq!(p, points());
        }
    }
}
