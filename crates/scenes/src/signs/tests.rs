use super::*;
use diorama_geom::glam::dvec2;

fn pictures(stage: &Stage) -> Vec<ImageU8> {
    stage.boards.iter().map(|_| ImageU8 { width: 2, height: 2, channels: 3, data: vec![200; 12] }).collect()
}

#[test]
fn board_coordinates_are_right_up_and_invertible_also_where_it_bends() {
    let flat = Board::flat([1.0, 2.0, 1.5], 0.3, [1.2, 0.4]).leaning(0.2).rolled(0.1);
    for board in [flat, flat.bent(0.7)] {
        for at in [dvec2(0.0, 0.0), dvec2(0.55, -0.15), dvec2(-0.6, 0.2)] {
            assert!((board.locate(board.point(at)) - at).length() < 1e-12);
            let [right, up] = [dvec2(1e-6, 0.0), dvec2(0.0, 1e-6)].map(|d| (board.point(at + d) - board.point(at)) / 1e-6);
            let face = board.world_from_face(at.x);
            assert!((face.x_axis - right).length() < 1e-5 && (face.y_axis - up).length() < 1e-5);
            assert!((face.determinant() - 1.0).abs() < 1e-12);
        }
    }
    // A reader who looks along +y sees the reading direction to the right and what is above above; leaning back shows the face to the sky.
    let board = Board::flat([0.0; 3], 0.0, [1.0, 1.0]).leaning(0.3);
    let face = board.world_from_face(0.0);
    assert!(face.x_axis.x > 0.99 && face.y_axis.z > 0.9 && face.z_axis.y < -0.9 && face.z_axis.z > 0.2);
    // A bent board recedes at its ends.
    let bent = Board::flat([0.0; 3], 0.0, [1.0, 1.0]).bent(0.5);
    assert!(bent.point(dvec2(0.5, 0.0)).y > 0.1 && bent.world_from_face(0.5).z_axis.x > 0.5);
}

#[test]
fn what_faces_an_eye_ends_where_normals_turn_away() {
    let bent = Board::flat([1.0, 0.5, 1.0], 0.4, [1.6, 0.5]).bent(0.6);
    for eye in [DVec3::new(1.5, -2.0, 1.4), DVec3::new(-1.5, 0.3, 1.0), DVec3::new(4.0, 0.2, 0.0)] {
        let faces = |x: f64| bent.world_from_face(x).z_axis.dot(eye - bent.point(dvec2(x, 0.1))) > 0.0;
        let columns: Vec<f64> = (0..=400).map(|k| -0.8 + 0.004 * k as f64).collect();
        match bent.facing(eye) {
            None => assert!(columns.iter().all(|x| !faces(*x))),
            Some([low, high]) => {
                assert!(columns.iter().all(|x| (low + 1e-9..high - 1e-9).contains(x) <= faces(*x) && (faces(*x) <= (low - 1e-9..high + 1e-9).contains(x))));
            }
        }
    }
    let flat = Board::flat([0.0; 3], 0.0, [1.0, 1.0]);
    assert!(flat.facing(DVec3::new(3.0, -0.1, 0.0)) == Some([-0.5, 0.5]) && flat.facing(DVec3::Y).is_none());
}

#[test]
fn every_board_of_every_family_is_in_sight_of_many_cameras() {
    for family in Family::ALL {
        for seed in [0, 7] {
            let stage = Stage::of(family, seed, usize::MAX);
            assert!(stage.boards.len() == 8 && family.most_boards() == 8);
            let cameras = stage.cameras(14, 96, 72);
            for (k, board) in stage.boards.iter().enumerate() {
                let seen = cameras.iter().filter(|(camera, pose)| {
                    let facing = board.world_from_face(0.0).z_axis.dot(pose.translation - board.point(dvec2(0.0, 0.0))) > 0.0;
                    facing && camera.shows(pose.inverse().point(board.point(dvec2(0.0, 0.0))))
                });
                let seen = seen.count();
                assert!(seen >= 4, "{} {seed}: board {k} is before {seen} of 14 cameras", family.name());
            }
        }
    }
}

#[test]
fn models_have_the_fronts_of_their_boards_and_fewer_boards_are_a_part_of_more() {
    for family in Family::ALL {
        let (all, few) = (Stage::of(family, 3, usize::MAX), Stage::of(family, 3, 2));
        assert!(few.boards.len() == 2 && few.boards.iter().all(|b| all.boards.contains(b)));
        let model = few.model(&pictures(&few));
        for k in 0..2 {
            let front = model.parts.iter().find(|p| p.name == format!("board.{k}.front")).expect("its front");
            let (low, high) = front.mesh.bounds().expect("corners");
            assert!((0..3).any(|a| high[a] - low[a] > 0.1));
            // Texture coordinates run to the right and down, from 0 to 1.
            let at =
                |uv: [f32; 2]| front.mesh.uvs.iter().position(|v| *v == uv).map(|i| DVec3::from(front.mesh.positions[i].map(f64::from)));
            let [top_left, top_right, low_left] = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]].map(|uv| at(uv).expect("a corner"));
            assert!(top_right.x > top_left.x && top_left.y > low_left.y, "{}", family.name());
        }
        assert!(model.instances.len() > 10 && Family::named(family.name()) == Some(family));
    }
    assert_eq!(Family::named("cave"), None);
}

#[test]
fn the_same_seed_is_the_same_place() {
    let model = |seed| {
        let stage = Stage::of(Family::Street, seed, 4);
        stage.model(&pictures(&stage))
    };
    assert!(model(5) == model(5) && model(5) != model(6));
}
