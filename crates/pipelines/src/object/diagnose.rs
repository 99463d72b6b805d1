//! `diorama doctor DATA`: what a capture holds, and what will likely go wrong with it in training.

use crate::error::Result;
use diorama_data::{masks, photo, pixel_store, sharpness, sparse};
use diorama_geom::capture::{Agreement, ColorSpace, Frame, MaskRule, Split, focus_point};
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Capture, Lens, Pose};
use rayon::prelude::*;
use serde::Serialize;

/// How bad something is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Grade {
    Good,
    /// Worth knowing.
    Note,
    /// Training will likely suffer.
    Trouble,
}

/// Result of one check.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    pub subject: &'static str,
    pub grade: Grade,
    pub text: String,
    /// What helps; empty where nothing is wrong.
    pub cure: String,
}

/// Most photographs that are opened, and the longest side at which they are compared.
const OPENED: usize = 60;
const LOOK_PX: usize = 400;

/// Fewer views than this are few.
const FEW_VIEWS: usize = 20;
/// Stops between the 5th and 95th percentile of brightness from which on exposure differs.
const STOPS: f32 = 0.7;
/// A photograph with less than this share of the middle one's sharpness is blurred.
const BLURRED: f32 = 0.25;
/// Share of clipped pixels from which on a photograph is overexposed.
const CLIPPED: f32 = 0.08;
/// Largest gap in degrees around what is looked at before a side counts as unseen.
const GAP_DEG: f64 = 75.0;

/// Looks at a capture; photographs are opened, nothing is written.
///
/// # Errors
/// When a photograph cannot be decoded.
pub fn diagnose(capture: &Capture) -> Result<Vec<Finding>> {
    let mut out = vec![views(capture)];
    out.extend(cameras(&capture.frames));
    out.extend(poses(capture));
    out.push(scale(capture));
    out.extend(capture.agreement.as_ref().map(model));
    out.extend(pixels(capture)?);
    out.push(memory(&capture.frames));
    out.extend(capture.notes.iter().map(|n| finding("import", Grade::Note, n.clone(), "")));
    Ok(out)
}

fn finding(subject: &'static str, grade: Grade, text: impl Into<String>, cure: impl Into<String>) -> Finding {
    Finding { subject, grade, text: text.into(), cure: cure.into() }
}

fn views(c: &Capture) -> Finding {
    let n = c.frames.len();
    let of = |s: Split| c.indices(s).len();
    let text = format!("{n} views: {} to train on, {} and {} held out", of(Split::Train), of(Split::Val), of(Split::Test));
    if of(Split::Train) < FEW_VIEWS {
        finding(
            "views",
            Grade::Note,
            text,
            "few: 30 to 150 photographs with much overlap are usual; what no camera saw stays empty or foggy",
        )
    } else {
        finding("views", Grade::Good, text, "")
    }
}

fn lens_name(l: &Lens) -> &'static str {
    match l {
        Lens::Pinhole => "pinhole",
        Lens::Brown { .. } => "Brown (OPENCV)",
        Lens::Fisheye { .. } => "fisheye",
        Lens::Fov { .. } => "FOV",
        Lens::Equirectangular => "equirectangular",
    }
}

/// Largest shift in pixels by which the lens bends the corners, against a pinhole; none where these are beyond one.
fn bend_px(c: &Camera) -> Option<f64> {
    let (w, h) = (c.width as f64, c.height as f64);
    [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)]
        .into_iter()
        .map(|(x, y)| {
            let d = c.direction(x, y);
            (d.z > 0.05).then(|| (d.x / d.z * c.fx + c.cx - x).hypot(d.y / d.z * c.fy + c.cy - y))
        })
        .try_fold(0.0, |most: f64, bend| bend.map(|b| most.max(b)))
}

fn cameras(frames: &[Frame]) -> Vec<Finding> {
    let first = frames[0].camera;
    let same = frames.iter().all(|f| f.camera == first);
    let (w, h) = (first.width as f64, first.height as f64);
    let angle = |a: DVec3, b: DVec3| a.normalize().dot(b.normalize()).clamp(-1.0, 1.0).acos().to_degrees();
    let fov = angle(first.direction(0.0, h / 2.0), first.direction(w, h / 2.0));
    let mut text = format!("{} x {} pixels, lens {}, {fov:.0} degrees wide", first.width, first.height, lens_name(&first.lens));
    if first.lens != Lens::Pinhole && first.lens != Lens::Equirectangular {
        match bend_px(&first) {
            Some(px) => text += &format!(", bends the corners by {px:.0} pixels"),
            None => text += ", reaches beyond a half-space",
        }
    }
    if !same {
        text += "; cameras differ between views (those of the first are shown)";
    }
    let mut out = vec![finding("camera", Grade::Good, text, "")];
    let mut trouble = |text: String, cure: &str| out.push(finding("camera", Grade::Trouble, text, cure));
    if first.lens == Lens::Pinhole && fov > 100.0 {
        trouble(
            format!("{fov:.0} degrees without any distortion are unusual"),
            "check the focal length; wide lenses need k1 to k4, or OPENCV_FISHEYE",
        );
    }
    if fov < 8.0 {
        trouble(format!("{fov:.1} degrees are a telescope's view"), "check fl_x and camera_angle_x: pixels and radians");
    }
    if first.lens != Lens::Equirectangular && !(0.9..1.1).contains(&(first.fx / first.fy)) {
        trouble(
            format!("pixels are not square: fl_x {:.0}, fl_y {:.0}", first.fx, first.fy),
            "check whether photographs were stretched, or w and h swapped",
        );
    }
    let off = ((first.cx / w - 0.5).abs()).max((first.cy / h - 0.5).abs());
    if off > 0.1 {
        let text = format!("the optical axis meets the picture at {:.0}, {:.0}, far from its middle", first.cx, first.cy);
        out.push(finding("camera", Grade::Note, text, "right for cropped photographs; else check cx and cy"));
    }
    out
}

fn poses(c: &Capture) -> Vec<Finding> {
    let poses: Vec<Pose> = c.frames.iter().map(|f| f.world_from_camera).collect();
    let (focus, distance) = focus_point(&poses);
    let mut out = Vec::new();
    // Around what is looked at.
    let mean_view = poses.iter().map(|p| p.rotation.z_axis).sum::<DVec3>() / poses.len() as f64;
    let to = |p: &Pose| (p.translation - focus).normalize_or(DVec3::X);
    let elevations: Vec<f64> = poses.iter().map(|p| to(p).z.asin().to_degrees()).collect();
    let (low, high) = elevations.iter().fold((f64::MAX, f64::MIN), |(a, b), e| (a.min(*e), b.max(*e)));
    let mut azimuths: Vec<f64> = poses.iter().map(|p| to(p).y.atan2(to(p).x).to_degrees()).collect();
    azimuths.sort_by(f64::total_cmp);
    let wrapped = azimuths.first().map(|a| a + 360.0);
    let gap = azimuths.iter().zip(azimuths.iter().skip(1).chain(&wrapped)).map(|(a, b)| b - a).fold(0.0, f64::max);
    let text = format!("cameras stand {low:.0} to {high:.0} degrees above what they look at, widest gap around it {gap:.0} degrees");
    out.push(if mean_view.length() > 0.85 {
        finding(
            "poses",
            Grade::Note,
            "all cameras look the same way",
            "views from the side and behind, and meshes of it, cannot be right; render with --path spiral",
        )
    } else if gap > GAP_DEG {
        finding("poses", Grade::Note, text, "the side that no camera looks at stays empty or foggy; walk all around if it matters")
    } else {
        finding("poses", Grade::Good, text, "")
    });
    let up = poses.iter().map(|p| -p.rotation.y_axis).sum::<DVec3>() / poses.len() as f64;
    let tilt = up.normalize_or(DVec3::Z).z.clamp(-1.0, 1.0).acos().to_degrees();
    if tilt > 35.0 && up.length() > 0.3 {
        let text = format!("the cameras' up is {tilt:.0} degrees off the world's z");
        out.push(finding("poses", Grade::Note, text, "orbits and meshes will lie tilted; `diorama prepare` levels the world"));
    }
    let near = |i: usize, j: usize| {
        (poses[i].translation - poses[j].translation).length() < 1e-4 * distance
            && (poses[i].rotation.z_axis - poses[j].rotation.z_axis).length() < 1e-4
    };
    let twins: Vec<(usize, usize)> =
        (0..poses.len()).flat_map(|i| (i + 1..poses.len()).map(move |j| (i, j))).filter(|(i, j)| near(*i, *j)).collect();
    let trained = |i: &usize| (c.frames[*i].split == Split::Train) as usize;
    for (of, what, grade, cure) in [
        (2, "pairs of training views have one pose", Grade::Trouble, "remove one of each, or find the poses again"),
        (1, "pairs of a held-out and a training view have one pose", Grade::Trouble, "scores on them say little: remove one of each"),
        (0, "pairs of held-out views have one pose", Grade::Note, "no harm where val and test are the same photographs"),
    ] {
        let same: Vec<_> = twins.iter().filter(|(i, j)| trained(i) + trained(j) == of).collect();
        if let Some((i, j)) = same.first() {
            let text = format!("{} {what}, for example {} and {}", same.len(), c.frames[*i].name, c.frames[*j].name);
            out.push(finding("poses", grade, text, cure));
        }
    }
    let lonely = strays(&poses);
    if !lonely.is_empty() {
        let names: Vec<&str> = lonely.iter().take(5).map(|i| &*c.frames[*i].name).collect();
        let text = format!("{} views stand far from all others: {}", lonely.len(), names.join(", "));
        out.push(finding(
            "poses",
            Grade::Note,
            text,
            "their poses may be wrong; look at sheet.png or in `diorama view`, remove what is wrong",
        ));
    }
    out
}

/// Views whose nearest neighbour is more than eight times as far as usual.
fn strays(poses: &[Pose]) -> Vec<usize> {
    let nearest = |i: usize| {
        let others = (0..poses.len()).filter(|j| *j != i);
        others.map(|j| (poses[i].translation - poses[j].translation).length()).fold(f64::MAX, f64::min)
    };
    let all: Vec<f64> = (0..poses.len()).map(nearest).collect();
    let mut sorted = all.clone();
    sorted.sort_by(f64::total_cmp);
    let usual = sorted[sorted.len() / 2].max(1e-9);
    (0..poses.len()).filter(|i| all[*i] > 8.0 * usual).collect()
}

fn scale(c: &Capture) -> Finding {
    let poses: Vec<Pose> = c.frames.iter().map(|f| f.world_from_camera).collect();
    let (focus, distance) = focus_point(&poses);
    let s = &c.scene;
    let outer = s.half * s.aabb_scale as f64;
    let off = (focus - s.center).abs().max_element();
    let text = format!(
        "cameras are {:.2} half cubes from what they look at, the outer cube is {} times the inner one; metres are not known",
        distance / s.half,
        s.aabb_scale
    );
    if off > outer {
        finding(
            "scale",
            Grade::Trouble,
            format!("what the cameras look at lies outside of the scene's cube ({text})"),
            "set scale, offset and aabb_scale in transforms.json, or let `diorama prepare` do it",
        )
    } else if distance > 12.0 * s.half {
        finding(
            "scale",
            Grade::Note,
            text,
            "the inner cube is small for these cameras: lower scale in transforms.json if the thing is cut off",
        )
    } else if distance < 0.25 * s.half {
        finding(
            "scale",
            Grade::Trouble,
            text,
            "everything lies in a small part of the cube and comes out coarse: raise scale in transforms.json",
        )
    } else {
        finding("scale", Grade::Good, text, "")
    }
}

/// What one photograph looks like.
struct Look {
    /// Log of the mean linear brightness, in stops.
    stops: f32,
    /// Variance of the Laplacian over that of the picture.
    sharpness: f32,
    clipped: f32,
    /// Share of pixels that are not opaque, and of those that a mask leaves out.
    clear: Option<f32>,
    masked: Option<f32>,
}

fn look(f: &Frame, rule: &MaskRule) -> Result<Look> {
    let full = photo::load(&f.image)?;
    let clear = (full.channels == 4).then(|| {
        let open = full.data.chunks_exact(4).filter(|p| p[3] < 128).count();
        open as f32 / (full.width * full.height) as f32
    });
    let mask = masks::of_frame(f, rule, (full.width, full.height))?;
    let masked = mask.as_ref().map(|m| m.data.iter().filter(|v| **v < masks::COUNTS).count() as f32 / m.data.len().max(1) as f32);
    let by = (LOOK_PX as f64 / full.width.max(full.height) as f64).min(1.0);
    let to = |v: usize| ((v as f64 * by) as usize).max(3);
    let small = full.downsampled(to(full.width), to(full.height));
    let mask = mask.map(|m| m.downsampled(small.width, small.height));
    let c = small.channels;
    let gray: Vec<u8> = small
        .data
        .chunks_exact(c)
        .map(|p| if c < 3 { p[0] } else { ((p[0] as u32 * 2 + p[1] as u32 * 5 + p[2] as u32) / 8) as u8 })
        .collect();
    let counts = |i: &usize| (c < 4 || small.data[i * 4 + 3] > 127) && mask.as_ref().is_none_or(|m| m.data[*i] >= masks::COUNTS);
    let seen: Vec<usize> = (0..gray.len()).filter(counts).collect();
    let n = seen.len().max(1) as f32;
    let mean = seen.iter().map(|i| linear_from_srgb(gray[*i] as f32 / 255.0)).sum::<f32>() / n;
    let middle = seen.iter().map(|i| gray[*i] as f32).sum::<f32>() / n;
    let variance = seen.iter().map(|i| (gray[*i] as f32 - middle).powi(2)).sum::<f32>() / n;
    Ok(Look {
        stops: mean.max(1e-6).log2(),
        sharpness: sharpness::laplacian_variance(&gray, small.width) / variance.max(1.0),
        // What is brighter than white is not lost in linear light.
        clipped: if f.color_space == ColorSpace::Linear { 0.0 } else { seen.iter().filter(|i| gray[**i] >= 250).count() as f32 / n },
        clear,
        masked,
    })
}

/// Whether poses and points of structure from motion agree.
fn model(a: &Agreement) -> Finding {
    match a.error_px {
        _ if a.is_broken() => finding("model", Grade::Trouble, sparse::broken(a), sparse::BROKEN_CURE),
        Some((mean, _)) => {
            finding("model", Grade::Good, format!("its points lie {mean:.1} pixels (mean) from where photographs show them"), "")
        }
        None => finding(
            "model",
            Grade::Trouble,
            format!(
                "{} of {} observations are of points that are not in the model: nothing says that its poses are right",
                a.absent, a.observations
            ),
            "run `diorama prepare` on the photographs",
        ),
    }
}

fn pixels(capture: &Capture) -> Result<Vec<Finding>> {
    let frames = &capture.frames;
    let n = frames.len();
    let opened: Vec<usize> = (0..n.min(OPENED)).map(|i| i * n / n.min(OPENED)).collect();
    let looks: Vec<Look> = opened.par_iter().map(|i| look(&frames[*i], &capture.masks)).collect::<Result<_>>()?;
    let at = |mut v: Vec<f32>, q: f32| {
        v.sort_by(f32::total_cmp);
        v[((v.len() - 1) as f32 * q) as usize]
    };
    let names = |which: &dyn Fn(&Look) -> bool| -> Vec<&str> {
        looks.iter().zip(&opened).filter(|(l, _)| which(l)).map(|(_, i)| &*frames[*i].name).collect()
    };
    let some = |v: &[&str]| v.iter().take(6).copied().collect::<Vec<_>>().join(", ") + if v.len() > 6 { " and others" } else { "" };
    let mut out = Vec::new();
    let stops: Vec<f32> = looks.iter().map(|l| l.stops).collect();
    let spread = at(stops.clone(), 0.95) - at(stops, 0.05);
    out.push(if spread > STOPS {
        finding(
            "exposure",
            Grade::Note,
            format!("brightness differs by {spread:.1} stops between views"),
            "if the camera did it, not the scene: `diorama prepare --normalize-exposure`, training gives each photograph an appearance code where it finds so (field.appearance)",
        )
    } else {
        finding("exposure", Grade::Good, format!("brightness differs by {spread:.1} stops between views"), "")
    });
    let usual = at(looks.iter().map(|l| l.sharpness).collect(), 0.5);
    let blurred = names(&|l| l.sharpness < BLURRED * usual);
    out.push(if blurred.is_empty() {
        finding("sharpness", Grade::Good, "no view is much less sharp than the others", "")
    } else {
        finding(
            "sharpness",
            Grade::Note,
            format!("{} views are much less sharp than the others: {}", blurred.len(), some(&blurred)),
            "leave them out",
        )
    });
    let bright = names(&|l| l.clipped > CLIPPED && l.clear.is_none());
    if !bright.is_empty() {
        let text = format!("{} views are white in more than {:.0} % of the picture: {}", bright.len(), 100.0 * CLIPPED, some(&bright));
        out.push(finding(
            "exposure",
            Grade::Note,
            text,
            "fine for a white background (--background white); else expose for the bright parts",
        ));
    }
    let mean = |v: Vec<f32>| v.iter().sum::<f32>() / v.len().max(1) as f32;
    let clear: Vec<f32> = looks.iter().filter_map(|l| l.clear).collect();
    if !clear.is_empty() {
        let text =
            format!("{} of {} views have alpha, {:.0} % of their pixels are clear", clear.len(), looks.len(), 100.0 * mean(clear.clone()));
        out.push(finding("masks", Grade::Good, text, ""));
    }
    let masked: Vec<f32> = looks.iter().filter_map(|l| l.masked).collect();
    if !masked.is_empty() {
        let share = mean(masked.clone());
        let text = format!("{} of {} views have masks, which leave out {:.0} % of their pixels", masked.len(), looks.len(), 100.0 * share);
        out.push(if share > 0.9 {
            finding("masks", Grade::Trouble, text, "black is left out, white counts: --mask invert if it is the other way round")
        } else {
            finding("masks", Grade::Good, text, "")
        });
    }
    Ok(out)
}

fn memory(frames: &[Frame]) -> Finding {
    let bytes: u64 = frames.iter().map(|f| f.camera.width as u64 * f.camera.height as u64 * 4).sum();
    let text = format!("{:.1} GiB of pixels", bytes as f64 / (1u64 << 30) as f64);
    if bytes > pixel_store::DEFAULT_BUDGET {
        let side = (bytes as f64 / pixel_store::DEFAULT_BUDGET as f64).sqrt().ceil();
        finding(
            "memory",
            Grade::Note,
            text,
            format!(
                "beyond data.memory_budget one pixel of each {side:.0} x {side:.0} is kept, which costs little; --downscale 2 is faster"
            ),
        )
    } else {
        finding("memory", Grade::Good, text, "")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_data::import::{self, ImportOptions};

    fn still_life(dir: &std::path::Path) -> Capture {
        super::super::quickstart::write_capture(dir, 24, 48).unwrap();
        import::import(dir, &ImportOptions::default()).unwrap()
    }

    fn worst<'a>(all: &'a [Finding], subject: &str) -> Option<&'a Finding> {
        all.iter().filter(|f| f.subject == subject).max_by_key(|f| f.grade as u8)
    }

    #[test]
    fn a_good_capture_has_no_trouble_and_a_spoilt_one_has_its_own() {
        let dir = tempfile::tempdir().unwrap();
        let good = still_life(dir.path());
        let found = diagnose(&good).unwrap();
        assert!(found.iter().all(|f| f.grade != Grade::Trouble), "{found:?}");
        assert!(found.iter().all(|f| (f.grade == Grade::Good) == f.cure.is_empty() || f.subject == "import"), "{found:?}");
        let spoilt = |change: &dyn Fn(&mut Capture)| {
            let mut c = good.clone();
            change(&mut c);
            diagnose(&c).unwrap()
        };
        let twins = spoilt(&|c| c.frames[3].world_from_camera = c.frames[2].world_from_camera);
        assert!(worst(&twins, "poses").unwrap().text.contains("training views have one pose"), "{twins:?}");
        let held_out = |of: &'static [usize]| {
            spoilt(&move |c| {
                of.iter().for_each(|i| c.frames[*i].split = Split::Test);
                c.frames[3].world_from_camera = c.frames[2].world_from_camera;
            })
        };
        let (leaked, twice) = (held_out(&[3]), held_out(&[2, 3]));
        assert!(worst(&leaked, "poses").is_some_and(|f| f.grade == Grade::Trouble && f.text.contains("a held-out and a training view")));
        assert_eq!(worst(&twice, "poses").unwrap().grade, Grade::Note, "{twice:?}");
        let outside = spoilt(&|c| c.scene.center = DVec3::splat(9.0));
        assert_eq!(worst(&outside, "scale").unwrap().grade, Grade::Trouble);
        let stretched = spoilt(&|c| c.frames.iter_mut().for_each(|f| f.camera.fy *= 1.5));
        assert!(worst(&stretched, "camera").unwrap().text.contains("square"));
        let one_side = spoilt(&|c| c.frames.truncate(12));
        assert_eq!(worst(&one_side, "poses").unwrap().grade, Grade::Note);
        let far = spoilt(&|c| c.frames[5].world_from_camera.translation *= 40.0);
        assert!(far.iter().any(|f| f.text.contains(&good.frames[5].name)), "{far:?}");
    }

    #[test]
    fn dark_and_blurred_photographs_are_told() {
        let dir = tempfile::tempdir().unwrap();
        let c = still_life(dir.path());
        let change = |i: usize, at: &dyn Fn(&diorama_geom::ImageU8, usize, usize, usize) -> u8| {
            let im = photo::load(&c.frames[i].image).unwrap();
            let mut out = im.clone();
            for (n, v) in out.data.iter_mut().enumerate().filter(|(n, _)| n % 4 < 3) {
                *v = at(&im, n / 4 % im.width, n / 4 / im.width, n % 4);
            }
            photo::save_png(&c.frames[i].image, &out).unwrap();
        };
        (0..6).for_each(|i| change(i, &|im, x, y, k| im.pixel(x, y)[k] / 3));
        change(9, &|im, x, y, k| {
            let at = |v: usize, d: usize, n: usize| (v + d).saturating_sub(3).min(n - 1);
            let sum: u32 = (0..49).map(|j| im.pixel(at(x, j % 7, im.width), at(y, j / 7, im.height))[k] as u32).sum();
            (sum / 49) as u8
        });
        let found = diagnose(&c).unwrap();
        assert_eq!(worst(&found, "exposure").unwrap().grade, Grade::Note);
        assert!(worst(&found, "sharpness").unwrap().text.contains(&c.frames[9].name), "{found:?}");
    }
}
