//! Camera intrinsics and lenses: projection, distortion, and its inverse.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Lens models: how directions become normalized image coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "model", rename_all = "snake_case")]
pub enum Lens {
    /// `x = X/Z`, no distortion.
    Pinhole,
    /// Brown–Conrady with OpenCV's rational radial term:
    /// `r = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)`, tangential `p1 p2`.
    Brown { k: [f64; 6], p: [f64; 2] },
    /// OpenCV's equidistant fisheye: `θd = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`, with thin-prism
    /// terms of COLMAP's THIN_PRISM_FISHEYE (zero otherwise).
    Fisheye { k: [f64; 4], p: [f64; 2], s: [f64; 2] },
    /// Devernay–Faugeras field-of-view model: `rd = atan(2 r tan(ω/2)) / ω`.
    Fov { omega: f64 },
    /// Longitude and latitude over the whole image; focal lengths and center are not used.
    Equirectangular,
}

/// How photographs are reduced before they are used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reduction {
    /// By a factor; sizes are rounded down, to at least one pixel.
    Times(u32),
    /// Until the shortest side has this many pixels; smaller photographs are unchanged.
    ShortestSide(u32),
}

impl Reduction {
    /// Width and height of a reduced image.
    pub fn size(self, (width, height): (u32, u32)) -> (u32, u32) {
        match self {
            Reduction::Times(n) => ((width / n.max(1)).max(1), (height / n.max(1)).max(1)),
            Reduction::ShortestSide(side) => {
                let shortest = width.min(height).max(1);
                if shortest <= side {
                    return (width, height);
                }
                let to = |v: u32| ((v as f64 * side as f64 / shortest as f64).round() as u32).max(1);
                (to(width), to(height))
            }
        }
    }
}

/// Intrinsics in pixels; pixel (i, j) covers `[i, i+1) × [j, j+1)`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    pub width: u32,
    pub height: u32,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    pub lens: Lens,
}

impl Camera {
    /// A pinhole camera with a horizontal field of view in radians and a centered principal point.
    pub fn pinhole(width: u32, height: u32, fov_x: f64) -> Camera {
        let f = 0.5 * width as f64 / (0.5 * fov_x).tan();
        Camera { width, height, fx: f, fy: f, cx: 0.5 * width as f64, cy: 0.5 * height as f64, lens: Lens::Pinhole }
    }

    /// A camera that sees the full sphere. Its focal lengths are pixels per radian at the horizon; nothing depends on them.
    pub fn equirectangular(width: u32, height: u32) -> Camera {
        let (w, h) = (width as f64, height as f64);
        let (fx, fy) = (w / std::f64::consts::TAU, h / std::f64::consts::PI);
        Camera { width, height, fx, fy, cx: 0.5 * w, cy: 0.5 * h, lens: Lens::Equirectangular }
    }

    /// The same camera for images resized to `width × height`.
    pub fn resized(&self, width: u32, height: u32) -> Camera {
        let (sx, sy) = (width as f64 / self.width as f64, height as f64 / self.height as f64);
        Camera { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy, lens: self.lens }
    }

    /// The same camera for images reduced `factor` times (sizes rounded down, at least one pixel).
    pub fn downscaled(&self, factor: u32) -> Camera {
        self.resized((self.width / factor).max(1), (self.height / factor).max(1))
    }

    /// The same camera for reduced images; each axis is scaled by its exact ratio.
    pub fn reduced(&self, by: Reduction) -> Camera {
        let (width, height) = by.size((self.width, self.height));
        self.resized(width, height)
    }

    /// Unit direction, in the camera, of the ray through pixel coordinates (x, y).
    pub fn direction(&self, x_px: f64, y_px: f64) -> DVec3 {
        if let Lens::Equirectangular = self.lens {
            let lon = (x_px / self.width as f64 - 0.5) * std::f64::consts::TAU;
            let lat = (y_px / self.height as f64 - 0.5) * std::f64::consts::PI;
            return DVec3::new(lon.sin() * lat.cos(), lat.sin(), lon.cos() * lat.cos());
        }
        let d = DVec2::new((x_px - self.cx) / self.fx, (y_px - self.cy) / self.fy);
        match self.lens {
            Lens::Fisheye { .. } => {
                let theta = self.lens.invert(d);
                let t = theta.length();
                let s = if t > 1e-12 { t.sin() / t } else { 1.0 };
                DVec3::new(theta.x * s, theta.y * s, t.cos()).normalize()
            }
            _ => {
                let n = self.lens.invert(d);
                DVec3::new(n.x, n.y, 1.0).normalize()
            }
        }
    }

    /// Pixel coordinates of a point in camera coordinates. `None` behind a perspective camera, and where a fisheye lens does not reach:
    /// beyond the angle at which its polynomial stops growing, or straight behind.
    pub fn project(&self, x_in_camera: DVec3) -> Option<DVec2> {
        let p = x_in_camera;
        let d = match self.lens {
            Lens::Equirectangular => {
                let n = p.normalize();
                return Some(DVec2::new(
                    (n.x.atan2(n.z) / std::f64::consts::TAU + 0.5) * self.width as f64,
                    (n.y.clamp(-1.0, 1.0).asin() / std::f64::consts::PI + 0.5) * self.height as f64,
                ));
            }
            Lens::Fisheye { .. } => {
                let r = DVec2::new(p.x, p.y).length();
                let theta = r.atan2(p.z);
                if !self.lens.reaches(theta) || (r <= 1e-12 && p.z <= 0.0) {
                    return None;
                }
                let u = if r > 1e-12 { DVec2::new(p.x, p.y) * (theta / r) } else { DVec2::ZERO };
                self.lens.distort(u)
            }
            _ if p.z <= 1e-9 => return None,
            _ => self.lens.distort(DVec2::new(p.x / p.z, p.y / p.z)),
        };
        Some(DVec2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy))
    }

    /// Whether the picture shows a point, in camera coordinates, if nothing stands before it.
    pub fn shows(&self, x_in_camera: DVec3) -> bool {
        let at = self.project(x_in_camera);
        at.is_some_and(|p| (0.0..self.width as f64).contains(&p.x) && (0.0..self.height as f64).contains(&p.y))
    }
}

impl Lens {
    /// Ideal to distorted normalized coordinates. For a fisheye the ideal coordinates are
    /// `θ (cos φ, sin φ)`, for the others `(X/Z, Y/Z)`.
    pub fn distort(&self, u: DVec2) -> DVec2 {
        let r2 = u.length_squared();
        let prism = |p: &[f64; 2]| {
            DVec2::new(2.0 * p[0] * u.x * u.y + p[1] * (r2 + 2.0 * u.x * u.x), 2.0 * p[1] * u.x * u.y + p[0] * (r2 + 2.0 * u.y * u.y))
        };
        match self {
            Lens::Pinhole | Lens::Equirectangular => u,
            Lens::Brown { k, p } => {
                let num = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
                let den = 1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
                u * (num / den) + prism(p)
            }
            Lens::Fisheye { k, p, s } => {
                let radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * (k[2] + r2 * k[3])));
                u * radial + prism(p) + DVec2::new(s[0], s[1]) * r2
            }
            Lens::Fov { omega } => {
                let r = r2.sqrt();
                if r < 1e-9 || *omega < 1e-9 { u } else { u * ((2.0 * r * (omega / 2.0).tan()).atan() / (omega * r)) }
            }
        }
    }

    /// Whether a fisheye's image radius grows with the angle from the axis up to `theta`; beyond that, its polynomial is meaningless.
    fn reaches(&self, theta: f64) -> bool {
        let Lens::Fisheye { k, .. } = self else { return true };
        // d(θ + k1 θ³ + …)/dθ
        let slope = |t: f64| {
            let t2 = t * t;
            1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
        };
        k.iter().all(|k| *k >= 0.0) || (1..=8).all(|i| slope(theta * i as f64 / 8.0) > 0.0)
    }

    /// Inverts [`Lens::distort`] by Newton's method with a central-difference Jacobian.
    pub fn invert(&self, d: DVec2) -> DVec2 {
        match self {
            Lens::Pinhole | Lens::Equirectangular => return d,
            Lens::Brown { k, p } if k == &[0.0; 6] && p == &[0.0; 2] => return d,
            Lens::Fov { omega } => {
                let r = d.length();
                if r < 1e-9 || *omega < 1e-9 {
                    return d;
                }
                return d * ((r * omega).tan() / (2.0 * r * (omega / 2.0).tan()));
            }
            _ => {}
        }
        let mut u = d;
        let h = 1e-6;
        for _ in 0..20 {
            let e = self.distort(u) - d;
            if e.length_squared() < 1e-24 {
                break;
            }
            let jx = (self.distort(u + DVec2::new(h, 0.0)) - self.distort(u - DVec2::new(h, 0.0))) / (2.0 * h);
            let jy = (self.distort(u + DVec2::new(0.0, h)) - self.distort(u - DVec2::new(0.0, h))) / (2.0 * h);
            let det = jx.x * jy.y - jy.x * jx.y;
            if det.abs() < 1e-12 {
                break;
            }
            u -= DVec2::new(jy.y * e.x - jy.x * e.y, jx.x * e.y - jx.y * e.x) / det;
        }
        u
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lenses() -> Vec<Lens> {
        vec![
            Lens::Pinhole,
            Lens::Brown { k: [0.0578, -0.0805, 0.01, 0.0, 0.0, 0.0], p: [-9.8e-4, 1.6e-4] },
            Lens::Brown { k: [0.2, 0.05, 0.01, 0.1, 0.02, 0.001], p: [1e-3, -2e-3] },
            Lens::Fisheye { k: [0.02, -0.005, 0.001, 0.0], p: [0.0; 2], s: [0.0; 2] },
            Lens::Fisheye { k: [0.02, -0.005, 0.001, 0.0], p: [1e-3, 2e-3], s: [1e-3, -1e-3] },
            Lens::Fov { omega: 0.8 },
            Lens::Equirectangular,
        ]
    }

    #[test]
    fn a_picture_shows_what_lies_along_its_rays_alone() {
        let camera = Camera::pinhole(40, 30, 1.0);
        let along = |x: f64, y: f64| 3.0 * camera.direction(x, y);
        assert!([(0.5, 0.5), (20.0, 29.5), (39.5, 1.0)].iter().all(|(x, y)| camera.shows(along(*x, *y))));
        assert!([(-1.0, 1.0), (41.0, 1.0), (1.0, -1.0), (1.0, 31.0)].iter().all(|(x, y)| !camera.shows(along(*x, *y))));
        assert!(!camera.shows(-along(20.0, 15.0)), "behind it");
    }

    #[test]
    fn project_undoes_direction_for_every_lens() {
        for lens in lenses() {
            let c = Camera { width: 640, height: 480, fx: 420.0, fy: 430.0, cx: 318.0, cy: 245.0, lens };
            for (x, y) in [(0.5, 0.5), (320.0, 240.0), (600.5, 13.5), (31.0, 460.0)] {
                let dir = c.direction(x, y);
                assert!((dir.length() - 1.0).abs() < 1e-12);
                let back = c.project(dir * 3.7).unwrap();
                assert!((back - DVec2::new(x, y)).length() < 1e-6, "{lens:?}: {back} for {x},{y}");
            }
        }
    }

    #[test]
    fn a_lens_of_200_degrees_sees_behind_itself() {
        for k in [[0.0; 4], [0.02, -0.005, 0.001, -0.0001], [-0.01, 0.0, 0.0, 0.0]] {
            let lens = Lens::Fisheye { k, p: [0.0; 2], s: [0.0; 2] };
            // The circle at 100° from the axis touches the image borders.
            let theta = 100f64.to_radians();
            let edge = lens.distort(DVec2::new(theta, 0.0)).x;
            let f = 500.0 / edge;
            let c = Camera { width: 1000, height: 1000, fx: f, fy: f, cx: 500.0, cy: 500.0, lens };
            for degrees in [0.0, 30.0, 89.0, 90.0, 91.0, 99.9] {
                for turn in 0..8 {
                    let (t, phi) = (f64::to_radians(degrees), turn as f64 * 0.8);
                    let d = DVec3::new(t.sin() * phi.cos(), t.sin() * phi.sin(), t.cos());
                    let px = c.project(d * 2.5).unwrap_or_else(|| panic!("{degrees}° is seen"));
                    assert!((0.0..=1000.0).contains(&px.x) && (0.0..=1000.0).contains(&px.y), "{px}");
                    assert!((c.direction(px.x, px.y) - d).length() < 1e-8, "{degrees}°, {k:?}");
                }
            }
            let left = c.direction(0.0, 500.0);
            assert!((left.angle_between(DVec3::Z) - theta).abs() < 1e-9 && left.z < 0.0 && left.x < 0.0);
            assert_eq!(c.project(-DVec3::Z), None, "straight behind is nowhere");
        }
    }

    #[test]
    fn a_fisheye_does_not_see_where_its_polynomial_turns_back() {
        // θ − 0.1 θ³ grows up to 105° and then falls: 150° would land inside the image.
        let lens = Lens::Fisheye { k: [-0.1, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 2] };
        let c = Camera { width: 1000, height: 1000, fx: 300.0, fy: 300.0, cx: 500.0, cy: 500.0, lens };
        let at = |degrees: f64| c.project(DVec3::new(degrees.to_radians().sin(), 0.0, degrees.to_radians().cos()));
        assert!(at(100.0).is_some());
        assert_eq!((at(110.0), at(150.0)), (None, None));
    }

    #[test]
    fn a_full_sphere_is_seen_once() {
        let c = Camera::equirectangular(720, 360);
        for (d, x, y) in [
            (DVec3::Z, 360.0, 180.0),
            (DVec3::X, 540.0, 180.0),
            (-DVec3::X, 180.0, 180.0),
            (DVec3::new(0.0, 1.0, 1e-9), 360.0, 360.0),
            (DVec3::new(0.0, -1.0, 1e-9), 360.0, 0.0),
        ] {
            assert!((c.project(d * 3.0).unwrap() - DVec2::new(x, y)).length() < 1e-3, "{d}");
        }
        for (x, y) in (0..72).flat_map(|x| (0..36).map(move |y| (x as f64 * 10.0 + 0.5, y as f64 * 10.0 + 0.5))) {
            let d = c.direction(x, y);
            assert!((d.length() - 1.0).abs() < 1e-12);
            assert!((c.project(d * 0.3).unwrap() - DVec2::new(x, y)).length() < 1e-6);
        }
        // The direction straight behind is the seam of the left and right border.
        let x = c.project(-DVec3::Z).unwrap().x;
        assert!(x < 1e-6 || (x - 720.0).abs() < 1e-6);
    }

    #[test]
    fn directions_point_right_and_down() {
        let c = Camera::pinhole(100, 80, 1.0);
        let d = c.direction(99.5, 79.5);
        assert!(d.x > 0.0 && d.y > 0.0 && d.z > 0.0);
    }

    #[test]
    fn downscaling_keeps_the_field_of_view() {
        let c = Camera { lens: Lens::Pinhole, ..Camera::pinhole(1080, 1920, 0.75) };
        let s = c.downscaled(4);
        assert_eq!((s.width, s.height), (270, 480));
        assert!((c.direction(1080.0, 0.0) - s.direction(270.0, 0.0)).length() < 1e-12);
    }

    #[test]
    fn a_shortest_side_is_met_exactly_and_the_corners_look_where_they_did() {
        let lens = Lens::Brown { k: [0.1, 0.01, 0.0, 0.0, 0.0, 0.0], p: [1e-3, 0.0] };
        for (width, height, reduced) in
            [(800, 800, (100, 100)), (1080, 1920, (100, 178)), (199, 150, (133, 100)), (640, 101, (634, 100)), (90, 60, (90, 60))]
        {
            let c = Camera { lens, cx: 0.4 * width as f64, ..Camera::pinhole(width, height, 0.75) };
            let s = c.reduced(Reduction::ShortestSide(100));
            assert_eq!((s.width, s.height), reduced);
            for (x, y) in [(0.0, 0.0), (1.0, 1.0), (0.3, 0.8)] {
                let at = |c: &Camera| c.direction(x * c.width as f64, y * c.height as f64);
                assert!((at(&c) - at(&s)).length() < 1e-9, "{width} x {height}");
            }
        }
        assert_eq!(Reduction::Times(8).size((1081, 7)), (135, 1));
    }
}
