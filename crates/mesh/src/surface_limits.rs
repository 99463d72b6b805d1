//! Recognizes an extracted surface that has vanished or exploded, so that training can start again.

use crate::tetrahedral_grid::TetrahedralGrid;
use diorama_kernels::ops::tetrahedral_surface::Surface;

/// Bounds within which a surface is usable.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceLimits {
    /// Least and largest area, in squared units of the grid.
    pub area: [f64; 2],
    /// Most faces.
    pub faces: usize,
}

/// Why a surface is unusable.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SurfaceFault {
    /// No edge of the grid has ends on both sides.
    Vanished,
    /// The area is below the limit.
    TooSmall { area: f64, limit: f64 },
    /// The area is above the limit.
    TooLarge { area: f64, limit: f64 },
    /// More faces than the limit.
    TooManyFaces { faces: usize, limit: usize },
    /// Vertices that are not finite.
    NotFinite { vertices: usize },
}

impl SurfaceFault {
    /// Whether the surface must grow to become usable; otherwise it must shrink or calm down.
    pub fn is_vanished(&self) -> bool {
        matches!(self, SurfaceFault::Vanished | SurfaceFault::TooSmall { .. })
    }
}

impl std::fmt::Display for SurfaceFault {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        match self {
            SurfaceFault::Vanished => write!(f, "the surface vanished"),
            SurfaceFault::TooSmall { area, limit } => {
                write!(f, "the surface almost vanished: area {area:.3e}, at least {limit:.3e} expected")
            }
            SurfaceFault::TooLarge { area, limit } => write!(f, "the surface exploded: area {area:.3e}, at most {limit:.3e} expected"),
            SurfaceFault::TooManyFaces { faces, limit } => write!(f, "the surface exploded: {faces} faces, at most {limit} expected"),
            SurfaceFault::NotFinite { vertices } => write!(f, "the surface exploded: {vertices} vertices are not finite"),
        }
    }
}

impl std::error::Error for SurfaceFault {}

impl SurfaceLimits {
    /// Usual limits: more area than a face of one cube; at most half as many faces as tetrahedra, and the area that so many have in noise
    /// (a tenth of a face of a cube each). [`TetrahedralGrid::random_distances`] pass, with 0.41 faces per tetrahedron; noise with as many
    /// vertices inside as outside has 1.25.
    pub fn of(grid: &TetrahedralGrid) -> SurfaceLimits {
        let (square, faces) = ((grid.cell as f64).powi(2), grid.topology.cells().len() / 2);
        SurfaceLimits { area: [square, 0.1 * square * faces as f64], faces }
    }

    /// Checks a surface.
    ///
    /// # Errors
    /// The first fault found.
    pub fn check(&self, surface: &Surface) -> Result<(), SurfaceFault> {
        if surface.faces.is_empty() {
            return Err(SurfaceFault::Vanished);
        }
        let vertices = surface.positions.iter().filter(|p| !p.iter().all(|v| v.is_finite())).count();
        if vertices > 0 {
            return Err(SurfaceFault::NotFinite { vertices });
        }
        if surface.faces.len() > self.faces {
            return Err(SurfaceFault::TooManyFaces { faces: surface.faces.len(), limit: self.faces });
        }
        match surface.area() {
            area if area < self.area[0] => Err(SurfaceFault::TooSmall { area, limit: self.area[0] }),
            area if area > self.area[1] => Err(SurfaceFault::TooLarge { area, limit: self.area[1] }),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_kernels::ops::tetrahedral_surface::cpu;

    fn check(grid: &TetrahedralGrid, s: &[f32]) -> Result<(), SurfaceFault> {
        let mut surface = Surface::default();
        cpu::extract(&grid.topology, s, &grid.rest, &mut surface);
        SurfaceLimits::of(grid).check(&surface)
    }

    #[test]
    fn starts_and_spheres_pass_and_faults_are_named() {
        for n in [8, 20] {
            let grid = TetrahedralGrid::lattice(n, 2.1);
            let sphere = |r: f32| -> Vec<f32> { grid.rest.iter().map(|p| r - p.iter().map(|v| v * v).sum::<f32>().sqrt()).collect() };
            for seed in 0..3 {
                assert_eq!(check(&grid, &grid.random_distances(seed)), Ok(()));
            }
            assert_eq!(check(&grid, &sphere(0.7)), Ok(()));
            assert_eq!(check(&grid, &sphere(-1.0)), Err(SurfaceFault::Vanished));
            // Everything inside is no surface either.
            assert_eq!(check(&grid, &sphere(5.0)), Err(SurfaceFault::Vanished));
            let mut one = sphere(-1.0);
            one[(n + 1).pow(3) + 1] = 0.01;
            let fault = check(&grid, &one).unwrap_err();
            assert!(matches!(fault, SurfaceFault::TooSmall { .. }) && fault.is_vanished(), "{fault}");
            let noise: Vec<f32> = grid.random_distances(1).iter().map(|s| s - 0.4).collect();
            let fault = check(&grid, &noise).unwrap_err();
            assert!(matches!(fault, SurfaceFault::TooManyFaces { .. }) && !fault.is_vanished(), "{fault}");
        }
    }

    #[test]
    fn area_and_numbers_are_checked() {
        let grid = TetrahedralGrid::lattice(8, 2.1);
        let s: Vec<f32> = grid.rest.iter().map(|p| 0.7 - p.iter().map(|v| v * v).sum::<f32>().sqrt()).collect();
        let mut surface = Surface::default();
        cpu::extract(&grid.topology, &s, &grid.rest, &mut surface);
        // A little less than 4 π 0.7².
        assert!((5.8..6.158).contains(&surface.area()), "{}", surface.area());
        let limits = SurfaceLimits { area: [0.0, 5.0], faces: usize::MAX };
        assert!(matches!(limits.check(&surface), Err(SurfaceFault::TooLarge { .. })));
        surface.positions[3][1] = f32::NAN;
        assert_eq!(limits.check(&surface), Err(SurfaceFault::NotFinite { vertices: 1 }));
    }
}
