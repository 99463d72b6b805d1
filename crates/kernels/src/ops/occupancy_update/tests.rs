use super::*;
use cases::{POINTS, comparable, grids, updates};
use diorama_testkit::{assert_close, wide};

#[test]
fn matches_the_reference() {
    for mut grid in grids() {
        for u in updates() {
            let (points, cells) = grid.probe(&u.rng, u.counter, POINTS, u.block);
            let (want_points, want_cells) = reference::probe(&grid, &u.rng, u.counter, POINTS, u.block);
            assert_close("points", &points, &want_points, 1e-5);
            assert_eq!(cells, want_cells);
            let want = u.want(&grid, &cells);
            u.apply(&mut grid, &cells);
            let density: Vec<f32> = comparable(wide(&grid.density)).iter().map(|d| *d as f32).collect();
            assert_close("densities", &density, &comparable(want.density), 1e-6);
            let occupied: Vec<bool> = (0..grid.bits.cells()).map(|i| grid.bits.get(i)).collect();
            assert!(occupied == want.occupied, "{} cells differ", occupied.iter().zip(&want.occupied).filter(|(a, b)| a != b).count());
            assert!(occupied.contains(&true) && occupied.contains(&false));
        }
    }
}

#[test]
fn densities_fall_where_nothing_is_met_again_and_unseen_cells_stay_empty() {
    let mut grid = OccupancyGrid::new(8, vec![1.0]);
    grid.density[0] = UNSEEN;
    grid.refresh();
    let all: Vec<u32> = (0..512).collect();
    grid.update(&all, &[5.0; 512], 1);
    assert!(grid.density[0] == UNSEEN && grid.density[1..].iter().all(|d| *d == 5.0));
    grid.record(&[3, 0], &[9.0, 9.0]);
    grid.update(&all, &[0.0; 512], 1);
    assert_eq!((grid.density[3], grid.density[4]), (9.0, 0.8 * 5.0));
    let occupied: Vec<usize> = (0..512).filter(|i| grid.bits.get(*i)).collect();
    assert_eq!(occupied.len(), 511, "all seen cells are denser than the threshold");
    assert!(!grid.bits.get(0));
}
