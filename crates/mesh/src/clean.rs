//! Removes floaters: small parts, and parts that the cameras' views contradict.

use crate::visibility::CameraVisibility;
use diorama_geom::{Camera, Mesh, Pose};
use rayon::prelude::*;

/// Keeps connected components that have at least `share` of the faces of the largest one; returns how many faces were removed.
pub fn remove_floaters(mesh: &mut Mesh, share: f32) -> usize {
    let parts = components(mesh);
    let largest = parts.iter().map(Vec::len).max().unwrap_or(0);
    let least = (largest as f32 * share).ceil() as usize;
    remove(mesh, parts.iter().filter(|p| p.len() < least))
}

/// Number of cameras that must see a part.
const MIN_CAMERAS: usize = 3;
/// Share of a part's faces that this many cameras must see. Of a closed part, about half faces away from every camera.
const SEEN: f64 = 0.05;
/// Most faces per part that are tested.
const TESTED_FACES: usize = 500;
/// A part stands in front of everything that a camera looks at if its farthest face is nearer than this share of the distance beyond which
/// nine tenths of the main part in the image lie.
const BEFORE: f64 = 0.5;

/// Number of removed faces, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Removed {
    /// In parts that fewer than three cameras see.
    pub unseen: usize,
    /// In parts close in front of a camera.
    pub before: usize,
}

/// Removes connected components that fewer than three of the `cameras` (or all, if there are fewer) see past the rest of the mesh, and
/// components that stand in front of everything that some camera looks at, unless more than half of the cameras see them farther away. The
/// component of which most is seen is always kept, including faces that no camera sees, such as its underside. `slack` is the error of the
/// surface in units of the mesh.
pub fn remove_unseen(mesh: &mut Mesh, cameras: &[(Camera, Pose)], slack: f32) -> Removed {
    let parts = components(mesh);
    if parts.len() < 2 || cameras.is_empty() {
        return Removed::default();
    }
    let centers: Vec<Vec<[f32; 3]>> = parts.iter().map(|p| face_centers(mesh, p)).collect();
    // For each camera and part: which of the tested faces it sees, and how far away.
    let views: Vec<View> = cameras.par_iter().map(|(c, pose)| View::new(&CameraVisibility::new(mesh, c, pose), &centers, slack)).collect();
    let needed = MIN_CAMERAS.min(cameras.len());
    let seen: Vec<f64> = (0..parts.len())
        .map(|p| {
            let by = |i: usize| views.iter().filter(|v| v.seen[p][i].is_some()).count();
            (0..centers[p].len()).filter(|i| by(*i) >= needed).count() as f64 / centers[p].len().max(1) as f64
        })
        .collect();
    let main = (0..parts.len()).max_by(|a, b| (seen[*a] * parts[*a].len() as f64).total_cmp(&(seen[*b] * parts[*b].len() as f64)));
    let main = main.unwrap_or(0);
    let is_unseen = |p: usize| p != main && seen[p] < SEEN;
    let is_before = |p: usize| {
        let (mut near, mut far) = (0, 0);
        for v in &views {
            match (v.farthest(p), v.subject(main)) {
                (Some(d), Some(subject)) if d < BEFORE * subject => near += 1,
                (Some(_), _) => far += 1,
                _ => {}
            }
        }
        p != main && near > 0 && far * 2 <= cameras.len()
    };
    let (unseen, rest): (Vec<usize>, Vec<usize>) = (0..parts.len()).partition(|p| is_unseen(*p));
    let before: Vec<usize> = rest.into_iter().filter(|p| is_before(*p)).collect();
    let faces = |which: &[usize]| which.iter().map(|p| parts[*p].len()).sum();
    let removed = Removed { unseen: faces(&unseen), before: faces(&before) };
    remove(mesh, unseen.iter().chain(&before).map(|p| &parts[*p]));
    removed
}

/// Removes connected components with less than `share` of the whole area; returns how many faces were removed.
pub fn remove_small_area(mesh: &mut Mesh, share: f64) -> usize {
    let parts = components(mesh);
    let area = |p: &Vec<u32>| p.iter().map(|f| face_area(mesh, *f)).sum::<f64>();
    let areas: Vec<f64> = parts.iter().map(area).collect();
    let least = share * areas.iter().sum::<f64>();
    let small: Vec<&Vec<u32>> = parts.iter().zip(&areas).filter(|(_, a)| **a < least).map(|(p, _)| p).collect();
    remove(mesh, small.into_iter())
}

/// Removes faces none of whose corners `least` of the cameras see (all, if there are fewer); returns how many. `slack` is the error of the
/// surface in units of the mesh.
pub fn remove_rarely_seen(mesh: &mut Mesh, cameras: &[(Camera, Pose)], least: usize, slack: f32) -> usize {
    let least = least.min(cameras.len());
    let views: Vec<CameraVisibility> = cameras.par_iter().map(|(c, pose)| CameraVisibility::new(mesh, c, pose)).collect();
    let is_seen = |p: &[f32; 3]| views.iter().filter(|v| v.sees(*p, slack)).take(least).count() == least;
    let seen: Vec<bool> = mesh.positions.par_iter().map(is_seen).collect();
    let before = mesh.faces.len();
    mesh.faces.retain(|f| f.iter().any(|i| seen[*i as usize]));
    mesh.compact();
    before - mesh.faces.len()
}

fn face_area(mesh: &Mesh, face: u32) -> f64 {
    let [a, b, c] = mesh.faces[face as usize].map(|i| glam::DVec3::from(mesh.positions[i as usize].map(f64::from)));
    0.5 * (b - a).cross(c - a).length()
}

/// Visibility of the tested faces from one camera.
struct View {
    /// Distance of each face of each part, if the camera sees it.
    seen: Vec<Vec<Option<f64>>>,
    /// Sorted distances of each part's faces inside the image, including occluded ones.
    in_picture: Vec<Vec<f64>>,
}

impl View {
    fn new(visibility: &CameraVisibility, centers: &[Vec<[f32; 3]>], slack: f32) -> View {
        let seen = |p: &[f32; 3]| visibility.distance(*p).filter(|_| visibility.sees(*p, slack));
        let in_picture = |part: &Vec<[f32; 3]>| {
            let mut d: Vec<f64> = part.iter().filter_map(|p| visibility.distance(*p)).collect();
            d.sort_by(f64::total_cmp);
            d
        };
        View {
            seen: centers.iter().map(|part| part.iter().map(seen).collect()).collect(),
            in_picture: centers.iter().map(in_picture).collect(),
        }
    }

    /// Distance of the farthest visible face of a part; `None` if none is visible.
    fn farthest(&self, part: usize) -> Option<f64> {
        self.seen[part].iter().flatten().copied().max_by(f64::total_cmp)
    }

    /// Distance beyond which nine tenths of a part's faces in the image lie.
    fn subject(&self, part: usize) -> Option<f64> {
        let d = &self.in_picture[part];
        d.get(d.len() / 10).copied()
    }
}

/// Centers of up to [`TESTED_FACES`] faces.
fn face_centers(mesh: &Mesh, faces: &[u32]) -> Vec<[f32; 3]> {
    let n = faces.len().min(TESTED_FACES);
    let center = |f: u32| {
        let [a, b, c] = mesh.faces[f as usize].map(|i| mesh.positions[i as usize]);
        std::array::from_fn(|k| (a[k] + b[k] + c[k]) / 3.0)
    };
    (0..n).map(|i| center(faces[i * faces.len() / n])).collect()
}

/// Groups faces by connected component: those that share vertices.
pub fn components(mesh: &Mesh) -> Vec<Vec<u32>> {
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for f in &mesh.faces {
        let a = root(&mut parent, f[0]);
        for &i in &f[1..] {
            let b = root(&mut parent, i);
            parent[b as usize] = a;
        }
    }
    let mut number = vec![u32::MAX; mesh.positions.len()];
    let mut parts: Vec<Vec<u32>> = Vec::new();
    for (i, f) in mesh.faces.iter().enumerate() {
        let r = root(&mut parent, f[0]) as usize;
        if number[r] == u32::MAX {
            number[r] = parts.len() as u32;
            parts.push(Vec::new());
        }
        parts[number[r] as usize].push(i as u32);
    }
    parts
}

/// Removes the faces of components; returns how many.
fn remove<'a>(mesh: &mut Mesh, parts: impl Iterator<Item = &'a Vec<u32>>) -> usize {
    let mut gone = vec![false; mesh.faces.len()];
    parts.flatten().for_each(|f| gone[*f as usize] = true);
    let mut each = gone.iter();
    mesh.faces.retain(|_| !each.next().is_some_and(|g| *g));
    mesh.compact();
    gone.iter().filter(|g| **g).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn components_go_by_their_area_and_not_by_their_faces() {
        let mut m = Mesh::default();
        // One large triangle, and a fan of many small ones.
        m.positions.extend([[0.0; 3], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]]);
        m.faces.push([0, 1, 2]);
        let first = m.positions.len() as u32;
        m.positions.push([20.0, 0.0, 0.0]);
        m.positions.extend((0..20).map(|i| [20.0 + 0.05 * (i as f32 * 0.1).cos(), 0.05 * (i as f32 * 0.1).sin(), 0.0]));
        m.faces.extend((1..20).map(|i| [first, first + i, first + i + 1]));
        assert_eq!(remove_small_area(&mut m, 1e-3), 19);
        assert_eq!((m.faces.len(), m.positions.len()), (1, 3));
    }

    #[test]
    fn small_islands_go_and_large_ones_stay() {
        // A strip of ten triangles, and a separate one.
        let mut m = Mesh::default();
        for i in 0..12 {
            m.positions.push([i as f32 * 0.5, (i % 2) as f32, 0.0]);
        }
        m.faces = (0..10).map(|i| [i, i + 1, i + 2]).collect();
        m.positions.extend([[50.0, 0.0, 0.0], [51.0, 0.0, 0.0], [50.0, 1.0, 0.0]]);
        m.faces.push([12, 13, 14]);
        let mut all = m.clone();
        assert_eq!(remove_floaters(&mut all, 0.05), 0);
        assert_eq!(all.faces.len(), 11);
        assert_eq!(remove_floaters(&mut m, 0.2), 1);
        assert_eq!((m.faces.len(), m.positions.len()), (10, 12));
    }

    /// Adds a ball; returns its number of faces.
    fn ball(m: &mut Mesh, center: DVec3, radius: f64, around: u32) -> usize {
        let (first, up) = (m.positions.len() as u32, around / 2);
        for j in 0..=up {
            for i in 0..around {
                let (a, b) = (i as f64 / around as f64 * std::f64::consts::TAU, j as f64 / up as f64 * std::f64::consts::PI);
                let p = center + radius * DVec3::new(b.sin() * a.cos(), b.sin() * a.sin(), b.cos());
                m.positions.push(p.as_vec3().to_array());
            }
        }
        let before = m.faces.len();
        for j in 0..up {
            for i in 0..around {
                let at = |j: u32, i: u32| first + j * around + i % around;
                m.faces.extend([[at(j, i), at(j + 1, i), at(j + 1, i + 1)], [at(j, i), at(j + 1, i + 1), at(j, i + 1)]]);
            }
        }
        m.faces.len() - before
    }

    fn camera(eye: DVec3, target: DVec3) -> (Camera, Pose) {
        (Camera::pinhole(320, 240, 1.0), Pose::look_at(eye, target, DVec3::new(0.1, 0.2, 1.0)))
    }

    /// Twelve cameras around the origin.
    fn ring() -> Vec<(Camera, Pose)> {
        let eye = |i: i32| {
            let a = i as f64 / 12.0 * std::f64::consts::TAU;
            DVec3::new(4.0 * a.cos(), 4.0 * a.sin(), 0.5)
        };
        (0..12).map(|i| camera(eye(i), DVec3::ZERO)).collect()
    }

    /// Number of remaining faces of each ball; the first ball is the object.
    fn left(balls: &[(DVec3, f64)], cameras: &[(Camera, Pose)]) -> (Vec<bool>, Removed, usize) {
        let mut m = Mesh::default();
        let faces: Vec<usize> = balls.iter().enumerate().map(|(i, (c, r))| ball(&mut m, *c, *r, if i == 0 { 64 } else { 16 })).collect();
        let removed = remove_unseen(&mut m, cameras, 0.02);
        let near = |(c, r): &(DVec3, f64)| m.positions.iter().any(|p| ((DVec3::from(p.map(f64::from)) - *c).length() - r).abs() < 1e-3);
        assert_eq!(faces.iter().sum::<usize>(), m.faces.len() + removed.unseen + removed.before);
        (balls.iter().map(near).collect(), removed, faces[1])
    }

    #[test]
    fn a_floater_before_one_camera_goes_although_others_see_it() {
        let cameras = ring();
        let eye = cameras[0].1.translation;
        // A fifth of the way from the camera to the object.
        let floater = (eye * 0.85, 0.1);
        let (stays, removed, faces) = left(&[(DVec3::ZERO, 1.0), floater], &cameras);
        assert_eq!(stays, [true, false]);
        assert_eq!(removed, Removed { unseen: 0, before: faces });
    }

    #[test]
    fn what_two_cameras_see_goes_and_what_three_see_stays() {
        let mut cameras = ring();
        let (two, three) = (DVec3::new(0.0, 0.0, 30.0), DVec3::new(0.0, 0.0, -30.0));
        for a in [0.0f64, 2.0] {
            cameras.push(camera(two + 3.0 * DVec3::new(a.cos(), a.sin(), 0.3), two));
        }
        for a in [0.0f64, 0.4, 0.8] {
            cameras.push(camera(three + 3.0 * DVec3::new(a.cos(), a.sin(), 0.3), three));
        }
        let (stays, removed, faces) = left(&[(DVec3::ZERO, 1.0), (two, 0.5), (three, 0.5)], &cameras);
        assert_eq!(stays, [true, false, true]);
        assert_eq!(removed, Removed { unseen: faces, before: 0 });
    }

    #[test]
    fn what_lies_within_the_object_goes_and_what_stands_beside_it_stays() {
        let beside = DVec3::new(0.0, 1.3, 0.4);
        let (stays, removed, faces) = left(&[(DVec3::ZERO, 1.0), (DVec3::ZERO, 0.5), (beside, 0.15)], &ring());
        assert_eq!(stays, [true, false, true]);
        assert_eq!(removed, Removed { unseen: faces, before: 0 });
    }

    #[test]
    fn a_part_alone_stays_whoever_sees_it() {
        let mut m = Mesh::default();
        let faces = ball(&mut m, DVec3::ZERO, 1.0, 16);
        let away = [camera(DVec3::new(3.0, 0.0, 0.0), DVec3::new(9.0, 0.0, 0.0))];
        assert_eq!(remove_unseen(&mut m, &away, 0.02), Removed::default());
        assert_eq!(m.faces.len(), faces);
    }
}
