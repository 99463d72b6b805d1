//! Tetrahedral meshes.

/// Tetrahedra over shared vertices.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tetrahedra {
    /// `[V, 3]`.
    pub positions: Vec<[f32; 3]>,
    /// Corners `[T, 4]`.
    pub cells: Vec<[u32; 4]>,
}

/// Numbers of tetrahedra that cannot be used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BadTetrahedra {
    /// All tetrahedra.
    pub cells: usize,
    /// With a corner that is not finite.
    pub not_finite: usize,
    /// Wound against the majority.
    pub inverted: usize,
    /// Without volume.
    pub flat: usize,
}

impl std::fmt::Display for BadTetrahedra {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let BadTetrahedra { cells, not_finite, inverted, flat } = self;
        write!(
            f,
            "of {cells} tetrahedra, {inverted} are inverted, {flat} have no volume, and {not_finite} have coordinates that are not finite"
        )
    }
}

impl std::error::Error for BadTetrahedra {}

/// Share of the cube of its longest edge below which a tetrahedron counts as flat.
const FLAT: f64 = 1e-7;

impl Tetrahedra {
    /// Volume of a cell; positive if corners 1, 2, 3 wind counter-clockwise seen from the side opposite to corner 0.
    ///
    /// # Panics
    /// When the cell or a corner of it does not exist.
    pub fn volume(&self, cell: usize) -> f64 {
        let [a, b, c, d] = self.corners(cell);
        (b - a).dot((c - a).cross(d - a)) / 6.0
    }

    fn corners(&self, cell: usize) -> [glam::DVec3; 4] {
        self.cells[cell].map(|i| glam::DVec3::from(self.positions[i as usize].map(f64::from)))
    }

    /// Gives every cell positive volume, if all of them wind alike.
    ///
    /// # Errors
    /// The numbers of cells that are inverted against the majority, flat, or not finite; nothing is changed then.
    ///
    /// # Panics
    /// When a corner does not exist.
    pub fn orient(&mut self) -> Result<(), BadTetrahedra> {
        let mut bad = BadTetrahedra { cells: self.cells.len(), ..BadTetrahedra::default() };
        let (mut positive, mut negative) = (0, 0);
        for cell in 0..self.cells.len() {
            let corners = self.corners(cell);
            let longest = (0..6).map(|k| [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)][k]).map(|(a, b)| corners[a].distance(corners[b]));
            let volume = self.volume(cell);
            match volume / longest.fold(0.0, f64::max).powi(3) {
                _ if corners.iter().any(|c| !c.is_finite()) => bad.not_finite += 1,
                v if v > FLAT => positive += 1,
                v if v < -FLAT => negative += 1,
                _ => bad.flat += 1,
            }
        }
        bad.inverted = positive.min(negative);
        if bad.inverted + bad.flat + bad.not_finite > 0 {
            return Err(bad);
        }
        if negative > 0 {
            self.cells.iter_mut().for_each(|c| c.swap(2, 3));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both halves of a square pyramid, wound alike.
    fn pyramid() -> Tetrahedra {
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 1.0]];
        Tetrahedra { positions, cells: vec![[4, 0, 2, 1], [4, 0, 3, 2]] }
    }

    #[test]
    fn all_cells_get_positive_volume() {
        for turned in [false, true] {
            let mut t = pyramid();
            if turned {
                t.cells.iter_mut().for_each(|c| c.swap(0, 1));
            }
            t.orient().unwrap();
            assert!((0..2).all(|i| (t.volume(i) - 1.0 / 6.0).abs() < 1e-12));
        }
    }

    #[test]
    fn bad_cells_are_counted() {
        let mut t = pyramid();
        t.cells.push([4, 0, 2, 1]);
        t.cells[1].swap(0, 1);
        assert_eq!(t.orient(), Err(BadTetrahedra { cells: 3, inverted: 1, ..BadTetrahedra::default() }));
        let mut t = pyramid();
        t.cells.push([0, 1, 2, 3]);
        assert_eq!(t.orient(), Err(BadTetrahedra { cells: 3, flat: 1, ..BadTetrahedra::default() }));
        let mut t = pyramid();
        t.positions[3][1] = f32::NAN;
        let bad = t.orient().unwrap_err();
        assert_eq!(bad, BadTetrahedra { cells: 2, not_finite: 1, ..BadTetrahedra::default() });
        assert_eq!(bad.to_string(), "of 2 tetrahedra, 0 are inverted, 0 have no volume, and 1 have coordinates that are not finite");
    }
}
