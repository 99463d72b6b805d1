//! Files of a COLMAP model: `cameras`, `images` and `points3D`, binary or text. Poses are camera-from-world, with quaternions (w, x, y,
//! z).

use crate::error::{self, DataError, Result};
use diorama_geom::glam::DVec3;
use diorama_geom::transform::rotation_from_quaternion;
use diorama_geom::{Camera, Lens, Pose};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Largest file that is read, in bytes.
const LIMIT: u64 = 16 << 30;

/// Camera models by COLMAP's id: name and number of parameters.
pub(crate) const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// One registered image.
pub(crate) struct Registered {
    pub id: u32,
    pub name: String,
    /// COLMAP's id of its camera.
    pub camera: u32,
    pub world_from_camera: Pose,
}

/// A keypoint that was matched with a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Keypoint {
    pub px: [f64; 2],
    /// [`Point::id`] of the point that it shows.
    pub point: Option<u64>,
}

/// Finds the folder of a model at or below `root`; of several sub-models, the one with the most images.
pub fn find_model(root: &Path) -> Option<PathBuf> {
    let mut candidates = vec![root.to_path_buf()];
    for base in ["sparse", "colmap/sparse", "colmap"] {
        let base = root.join(base);
        candidates.push(base.clone());
        let mut subs: Vec<PathBuf> = base.read_dir().into_iter().flatten().flatten().map(|e| e.path()).filter(|p| p.is_dir()).collect();
        subs.sort();
        candidates.extend(subs);
    }
    let size = |p: &Path| ["images.bin", "images.txt"].iter().filter_map(|n| std::fs::metadata(p.join(n)).ok()).map(|m| m.len()).max();
    let mut best: Option<(u64, PathBuf)> = None;
    for c in candidates {
        if let Some(s) = size(&c)
            && best.as_ref().is_none_or(|b| s > b.0)
        {
            best = Some((s, c));
        }
    }
    best.map(|b| b.1)
}

/// A 3D point found by structure from motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    pub id: u64,
    pub position: DVec3,
    pub rgb: [u8; 3],
    /// Mean reprojection error in pixels, as the model states it.
    pub error: f64,
    /// Ids of the images in which it was matched.
    pub images: usize,
}

/// Registered images of a model.
pub fn registered(model: &Path) -> Result<Vec<String>> {
    Ok(read_images_bin(&model.join("images.bin"), &mut |_, _| {})?.into_iter().map(|i| i.name).collect())
}

/// Keypoints of one image.
#[derive(Clone, Debug, PartialEq)]
pub struct Observed {
    pub image: String,
    /// Pixel and [`Point::id`].
    pub points: Vec<([f64; 2], u64)>,
}

/// Keypoints of all images of a model.
pub fn observations(model: &Path) -> Result<Vec<Observed>> {
    let mut out = Vec::new();
    read_images(model, &mut |image, keypoints| {
        let points = keypoints.iter().filter_map(|k| k.point.map(|p| (k.px, p))).collect();
        out.push(Observed { image: image.name.clone(), points });
    })?;
    Ok(out)
}

/// Reads the points of a model; empty if it has no points file.
///
/// # Errors
/// If the file ends too early or is malformed.
pub fn points(model: &Path) -> Result<Vec<Point>> {
    let mut out = Vec::new();
    each_point(model, &mut |point, _| out.push(point))?;
    Ok(out)
}

/// Calls `each` for every point with its track: pairs of image id and keypoint index.
pub(crate) fn each_point(model: &Path, each: &mut dyn FnMut(Point, &[(u32, u32)])) -> Result<()> {
    let (binary, text) = (model.join("points3D.bin"), model.join("points3D.txt"));
    if binary.exists() {
        each_point_bin(&binary, each)
    } else if text.exists() {
        each_point_txt(&text, each)
    } else {
        Ok(())
    }
}

fn each_point_bin(file: &Path, each: &mut dyn FnMut(Point, &[(u32, u32)])) -> Result<()> {
    let data = error::read(file, LIMIT)?;
    let mut b = Bytes { file, data: &data };
    let n = b.u64()?;
    let mut track = Vec::new();
    for _ in 0..n {
        let id = b.u64()?;
        let position = DVec3::new(b.f64()?, b.f64()?, b.f64()?);
        let rgb = b.take(3)?.try_into().expect("three bytes");
        let error = b.f64()?;
        let images = b.u64()?;
        let bytes = b.take(usize::try_from(images).ok().and_then(|p| p.checked_mul(8)).unwrap_or(usize::MAX))?;
        let word = |b: &[u8]| u32::from_le_bytes(b.try_into().expect("four bytes"));
        track.clear();
        track.extend(bytes.chunks_exact(8).map(|t| (word(&t[..4]), word(&t[4..]))));
        each(Point { id, position, rgb, error, images: track.len() }, &track);
    }
    Ok(())
}

fn each_point_txt(file: &Path, each: &mut dyn FnMut(Point, &[(u32, u32)])) -> Result<()> {
    let mut track = Vec::new();
    for (i, line) in text(file)?.lines().enumerate() {
        if line.starts_with('#') || line.trim().is_empty() {
            continue;
        }
        let wrong = || malformed(file, i, "expected POINT3D_ID X Y Z R G B ERROR and pairs of IMAGE_ID POINT2D_IDX");
        let f: Vec<&str> = line.split_whitespace().collect();
        if f.len() < 8 || f.len() % 2 == 1 {
            return Err(wrong());
        }
        let number = |k: usize| f[k].parse::<f64>().map_err(|_| wrong());
        let color = |k: usize| f[k].parse::<u8>().map_err(|_| wrong());
        track.clear();
        for pair in f[8..].chunks_exact(2) {
            let [image, keypoint] = [0, 1].map(|k| pair[k].parse::<u32>().map_err(|_| wrong()));
            track.push((image?, keypoint?));
        }
        let id = f[0].parse().map_err(|_| wrong())?;
        let position = DVec3::new(number(1)?, number(2)?, number(3)?);
        each(Point { id, position, rgb: [color(4)?, color(5)?, color(6)?], error: number(7)?, images: track.len() }, &track);
    }
    Ok(())
}

/// Reads the cameras of a model, by their ids.
pub(crate) fn read_cameras(model: &Path) -> Result<HashMap<u32, Camera>> {
    let binary = model.join("cameras.bin");
    if model.join("images.bin").exists() { read_cameras_bin(&binary) } else { read_cameras_txt(&model.join("cameras.txt")) }
}

/// Reads the registered images; `each` is called for every image with its keypoints.
pub(crate) fn read_images(model: &Path, each: &mut dyn FnMut(&Registered, &[Keypoint])) -> Result<Vec<Registered>> {
    let binary = model.join("images.bin");
    if binary.exists() { read_images_bin(&binary, each) } else { read_images_txt(&model.join("images.txt"), each) }
}

/// Builds a camera from a model's id, size and parameters.
fn camera(file: &Path, model: usize, width: u64, height: u64, p: &[f64]) -> Result<Camera> {
    let &(name, n) = MODELS.get(model).ok_or_else(|| {
        DataError::input(file, format!("camera model {model} is not supported; use one of {}", MODELS.map(|m| m.0).join(", ")))
    })?;
    if p.len() != n || p.iter().any(|v| !v.is_finite()) || p[0] <= 0.0 {
        return Err(DataError::input(file, format!("camera model {name} needs {n} finite numbers, the focal length above 0")));
    }
    if width == 0 || height == 0 || width > 1 << 20 || height > 1 << 20 {
        return Err(DataError::input(file, format!("camera size {width}×{height} is not plausible; run COLMAP again")));
    }
    let brown = |k: [f64; 6], p: [f64; 2]| Lens::Brown { k, p };
    let fisheye = |k: [f64; 4]| Lens::Fisheye { k, p: [0.0; 2], s: [0.0; 2] };
    let shared = matches!(model, 0 | 2 | 3 | 8 | 9);
    let (fx, fy, cx, cy, rest) = if shared { (p[0], p[0], p[1], p[2], &p[3..]) } else { (p[0], p[1], p[2], p[3], &p[4..]) };
    let lens = match model {
        0 | 1 => Lens::Pinhole,
        2 => brown([rest[0], 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        3 => brown([rest[0], rest[1], 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        4 => brown([rest[0], rest[1], 0.0, 0.0, 0.0, 0.0], [rest[2], rest[3]]),
        5 => fisheye([rest[0], rest[1], rest[2], rest[3]]),
        6 => brown([rest[0], rest[1], rest[4], rest[5], rest[6], rest[7]], [rest[2], rest[3]]),
        7 => Lens::Fov { omega: rest[0] },
        8 => fisheye([rest[0], 0.0, 0.0, 0.0]),
        9 => fisheye([rest[0], rest[1], 0.0, 0.0]),
        _ => Lens::Fisheye { k: [rest[0], rest[1], rest[4], rest[5]], p: [rest[2], rest[3]], s: [rest[6], rest[7]] },
    };
    Ok(Camera { width: width as u32, height: height as u32, fx, fy, cx, cy, lens })
}

fn pose(q: [f64; 4], t: [f64; 3]) -> Pose {
    Pose { rotation: rotation_from_quaternion(q), translation: DVec3::from_array(t) }.inverse()
}

/// Byte cursor whose errors name the file if the bytes end too early.
struct Bytes<'a> {
    file: &'a Path,
    data: &'a [u8],
}

impl<'a> Bytes<'a> {
    fn take(&mut self, n: usize) -> Result<&'a [u8]> {
        if self.data.len() < n {
            return Err(DataError::input(self.file, "ends too early; copy it again or run COLMAP again"));
        }
        let (head, tail) = self.data.split_at(n);
        self.data = tail;
        Ok(head)
    }

    fn u32(&mut self) -> Result<u32> {
        Ok(u32::from_le_bytes(self.take(4)?.try_into().expect("four bytes")))
    }

    fn u64(&mut self) -> Result<u64> {
        Ok(u64::from_le_bytes(self.take(8)?.try_into().expect("eight bytes")))
    }

    fn f64(&mut self) -> Result<f64> {
        Ok(f64::from_le_bytes(self.take(8)?.try_into().expect("eight bytes")))
    }
}

fn read_cameras_bin(file: &Path) -> Result<HashMap<u32, Camera>> {
    let data = error::read(file, LIMIT)?;
    let mut b = Bytes { file, data: &data };
    let n = b.u64()?;
    let mut out = HashMap::new();
    for _ in 0..n {
        let (id, model, w, h) = (b.u32()?, b.u32()? as usize, b.u64()?, b.u64()?);
        let count = MODELS.get(model).map_or(0, |m| m.1);
        let params = (0..count).map(|_| b.f64()).collect::<Result<Vec<f64>>>()?;
        out.insert(id, camera(file, model, w, h, &params)?);
    }
    Ok(out)
}

fn read_images_bin(file: &Path, each: &mut dyn FnMut(&Registered, &[Keypoint])) -> Result<Vec<Registered>> {
    /// COLMAP's id of a keypoint that belongs to no point.
    const NONE: u64 = u64::MAX;
    let data = error::read(file, LIMIT)?;
    let mut b = Bytes { file, data: &data };
    let n = b.u64()?;
    let (mut out, mut keypoints) = (Vec::new(), Vec::new());
    for _ in 0..n {
        let id = b.u32()?;
        let mut v = [0.0; 7];
        for x in &mut v {
            *x = b.f64()?;
        }
        let camera = b.u32()?;
        let end = b.data.iter().position(|c| *c == 0).ok_or_else(|| DataError::input(file, "ends inside an image name"))?;
        let name = String::from_utf8_lossy(b.take(end)?).into_owned();
        b.take(1)?;
        let points = b.u64()?;
        let bytes = b.take(usize::try_from(points).ok().and_then(|p| p.checked_mul(24)).unwrap_or(usize::MAX))?;
        let word = |k: &[u8], i: usize| u64::from_le_bytes(k[8 * i..8 * i + 8].try_into().expect("eight bytes"));
        keypoints.clear();
        keypoints.extend(bytes.chunks_exact(24).map(|k| Keypoint {
            px: [f64::from_bits(word(k, 0)), f64::from_bits(word(k, 1))],
            point: Some(word(k, 2)).filter(|p| *p != NONE),
        }));
        let image = Registered { id, name, camera, world_from_camera: pose([v[0], v[1], v[2], v[3]], [v[4], v[5], v[6]]) };
        each(&image, &keypoints);
        out.push(image);
    }
    Ok(out)
}

fn text(file: &Path) -> Result<String> {
    String::from_utf8(error::read(file, LIMIT)?).map_err(|_| DataError::input(file, "is not UTF-8 text"))
}

fn malformed(file: &Path, line: usize, what: &str) -> DataError {
    DataError::input(file, format!("line {}: {what}", line + 1))
}

fn read_cameras_txt(file: &Path) -> Result<HashMap<u32, Camera>> {
    let mut out = HashMap::new();
    for (i, line) in text(file)?.lines().enumerate() {
        if line.starts_with('#') || line.trim().is_empty() {
            continue;
        }
        let f: Vec<&str> = line.split_whitespace().collect();
        let expected = "expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS";
        if f.len() < 5 {
            return Err(malformed(file, i, expected));
        }
        let model = MODELS.iter().position(|m| m.0 == f[1]).ok_or_else(|| {
            malformed(file, i, &format!("camera model {} is not supported; use one of {}", f[1], MODELS.map(|m| m.0).join(", ")))
        })?;
        let number = |s: &str| s.parse::<f64>().map_err(|_| malformed(file, i, expected));
        let params = f[4..].iter().map(|s| number(s)).collect::<Result<Vec<f64>>>()?;
        out.insert(number(f[0])? as u32, camera(file, model, number(f[2])? as u64, number(f[3])? as u64, &params)?);
    }
    Ok(out)
}

fn read_images_txt(file: &Path, each: &mut dyn FnMut(&Registered, &[Keypoint])) -> Result<Vec<Registered>> {
    let (mut out, mut keypoints) = (Vec::new(), Vec::new());
    let all = text(file)?;
    let mut lines = all.lines().enumerate().filter(|(_, l)| !l.starts_with('#'));
    while let Some((i, line)) = lines.next() {
        if line.trim().is_empty() {
            continue;
        }
        let f: Vec<&str> = line.split_whitespace().collect();
        let expected = "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME";
        if f.len() < 10 {
            return Err(malformed(file, i, expected));
        }
        let v = f[..9].iter().map(|s| s.parse::<f64>().map_err(|_| malformed(file, i, expected))).collect::<Result<Vec<f64>>>()?;
        let world_from_camera = pose([v[1], v[2], v[3], v[4]], [v[5], v[6], v[7]]);
        let image = Registered { id: v[0] as u32, name: f[9..].join(" "), camera: v[8] as u32, world_from_camera };
        keypoints.clear();
        // The line of keypoints may be empty.
        if let Some((k, line)) = lines.next() {
            let wrong = || malformed(file, k, "expected groups of X Y POINT3D_ID");
            let numbers: Vec<&str> = line.split_whitespace().collect();
            if !numbers.len().is_multiple_of(3) {
                return Err(wrong());
            }
            for n in numbers.chunks_exact(3) {
                let [x, y] = [0, 1].map(|k| n[k].parse::<f64>().map_err(|_| wrong()));
                let point: i64 = n[2].parse().map_err(|_| wrong())?;
                keypoints.push(Keypoint { px: [x?, y?], point: u64::try_from(point).ok() });
            }
        }
        each(&image, &keypoints);
        out.push(image);
    }
    Ok(out)
}
