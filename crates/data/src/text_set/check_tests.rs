use super::*;

/// Checks that a changed image is refused with all of `expected`.
#[track_caller]
fn refused(change: impl FnOnce(&mut SetImage), expected: &[&str]) {
    let mut image = set().remove(0);
    check(&image).unwrap();
    change(&mut image);
    let error = check(&image).unwrap_err();
    assert!(expected.iter().all(|e| error.contains(e)), "{expected:?} are not all in {error:?}");
    // Nothing is written of it.
    let dir = tempfile::tempdir().unwrap();
    assert!(save(dir.path(), std::slice::from_ref(&image)).unwrap_err().to_string().contains(&error));
    assert!(write(dir.path(), &[image], &SetFormat::ALL).unwrap_err().to_string().contains(&error));
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn corners_outside_of_the_image_are_refused() {
    refused(|i| i.words[0].quad[1][0] = 100.1, &["word 0: quad: corner 1 at 100.1, 10.6 is outside of the image of 100×60", "clip"]);
    refused(|i| i.words[0].polygon[5][1] = -0.01, &["word 0: polygon: corner 5 at 10, -0.01 is outside"]);
    refused(|i| i.words[0].quad[2][1] = 60.0 + 2e-6, &["quad: corner 2", "outside"]);
    refused(|i| i.words[0].quad[0][0] = f64::NAN, &["quad: corner 0 is not a number", "behind the camera"]);
    refused(|i| i.words[0].polygon[3][1] = f64::INFINITY, &["polygon: corner 3 is not a number"]);
    refused(|i| i.words[0].characters[0].quad[3][0] = -2.0, &["word 0: character 0: corner 3", "outside"]);
}

#[test]
fn shapes_without_area_or_order_are_refused() {
    refused(|i| i.words[1].quad = upright(1.0, 40.0, 10.0, 0.0), &["word 1: quad: its corners enclose no area"]);
    refused(|i| i.words[1].quad.reverse(), &["word 1: quad: its corners are counterclockwise; order them"]);
    refused(|i| i.words[0].polygon.reverse(), &["word 0: polygon: its corners are counterclockwise"]);
    refused(|i| i.words[1].quad.swap(0, 1), &["word 1: quad: the side after corner", "crosses the side after corner"]);
    refused(|i| i.words[0].polygon.truncate(2), &["polygon: 2 corners; a polygon has at least 3"]);
    refused(|i| i.words[0].characters[0].quad.reverse(), &["character 0: its corners are counterclockwise"]);
    refused(|i| i.words[1].quad = upright(50.0, 1.0, 10.0, 5.0), &["word 1: its quad and its polygon are apart"]);
    refused(|i| i.words[0].characters[0].quad = upright(10.0, 50.0, 4.0, 4.0), &["character 0 is apart from its word"]);
}

#[test]
fn what_a_word_says_is_checked() {
    refused(|i| i.words[0].transcription = " \n".into(), &["word 0: its transcription is empty; write ###"]);
    refused(|i| i.words[0].visibility = 1.01, &["visibility 1.01 is no share"]);
    refused(|i| i.words[0].visibility = f64::NAN, &["visibility NaN is no share"]);
    let pose = |change: fn(&mut WordPose)| move |i: &mut SetImage| change(i.words[0].pose.as_mut().unwrap());
    refused(pose(|p| p.text_pose[2][2] = 1.0), &["word 0: pose: text_pose is no rotation", "mirroring"]);
    refused(pose(|p| p.text_pose[1][3] = f64::NAN), &["pose: text_pose holds what is not a number"]);
    refused(pose(|p| p.size[1] = 0.0), &["pose: size [1.5, 0.0]", "give both > 0"]);
    refused(pose(|p| p.quaternion[3] += 0.01), &["pose: its quaternion is not the rotation of text_pose; derive it"]);
    refused(pose(|p| p.quaternion = p.quaternion.map(|v| 2.0 * v)), &["pose: its quaternion is not"]);
    refused(pose(|p| p.quaternion[0] = f64::NAN), &["pose: its quaternion is not"]);
    refused(pose(|p| p.axis_angle[0] += 0.01), &["pose: its axis_angle is not the rotation of text_pose"]);
}

#[test]
fn names_sizes_and_cameras_are_checked() {
    for name in ["/tmp/a.png", "../a.png", "images//a.png", "images\\a.png", "a\tb.png", ""] {
        refused(|i| i.image = name.into(), &["is no path in the data set's folder; name it like images/000000.png"]);
    }
    refused(|i| i.image = "images/.png".into(), &["has no name and extension"]);
    refused(|i| i.image = "images/a".into(), &["has no name and extension"]);
    refused(|i| i.height = 0, &["an image of 100×0 has no pixels"]);
    refused(|i| i.intrinsic[1] = 0.0, &["intrinsic [80.5, 0.0, 50.0, 30.0] is no camera"]);
    refused(|i| i.intrinsic[2] = f64::NAN, &["is no camera; give fx, fy > 0"]);
    refused(|i| i.world_from_camera[0][0] = 1.1, &["world_from_camera is no rotation by"]);
    refused(|i| i.world_from_camera[0][3] = f64::INFINITY, &["world_from_camera holds what is not a number"]);
}

#[test]
fn images_of_one_name_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let images = [image("images/a.png", Vec::new()), image("other/A.jpg", Vec::new())];
    for error in [save(dir.path(), &images), write(dir.path(), &images, &SetFormat::ALL)] {
        let error = error.unwrap_err().to_string();
        assert!(error.contains("image 1: other/A.jpg has the name of images/a.png at image 0; give each image a name"), "{error}");
    }
    let lines: String = images.iter().map(|i| serde_json::to_string(i).unwrap() + "\n\n").collect();
    std::fs::write(dir.path().join(ANNOTATIONS), lines).unwrap();
    let error = read(dir.path()).unwrap_err().to_string();
    assert!(error.contains("annotations.jsonl: line 3: other/A.jpg has the name of images/a.png at line 1"), "{error}");
}

#[test]
fn reading_names_file_line_and_cure() {
    let dir = tempfile::tempdir().unwrap();
    let of = |bytes: &[u8]| {
        std::fs::write(dir.path().join(ANNOTATIONS), bytes).unwrap();
        let error = read(dir.path()).unwrap_err();
        assert!(error.is_input());
        error.to_string()
    };
    let outside = r#"{"image":"a.png","width":10,"height":10,"intrinsic":[9,9,5,5],"world_from_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,0]],"scene":"s","words":[{"id":0,"quad":[[1,1],[11,1],[11,4],[1,4]],"polygon":[[1,1],[9,1],[9,4]],"transcription":"A","visibility":1}]}"#;
    for (text, expected) in [
        (format!("{EXAMPLE}\n{outside}"), "annotations.jsonl: line 2: a.png: word 0: quad: corner 1 at 11, 1 is outside of the image"),
        (format!("\n{EXAMPLE}\n{{"), "annotations.jsonl: line 3: EOF"),
        (EXAMPLE.replace("\"scene\"", "\"place\""), "line 1: unknown field `place`"),
        (EXAMPLE.replace("640", "\"640\""), "expected a line such as {\"image\": \"images/000000.png\""),
        ("\n".into(), "annotations.jsonl: holds no image; write the data set again"),
    ] {
        let error = of(text.as_bytes());
        assert!(error.contains(expected), "{error}");
    }
    assert!(of(b"{\"image\": \"\xff\"}").contains("line 1: "));
    std::fs::remove_file(dir.path().join(ANNOTATIONS)).unwrap();
    let error = read(dir.path()).unwrap_err().to_string();
    assert!(error.contains("holds no annotations.jsonl; give the folder of a data set"), "{error}");
}
