use super::*;
use crate::text_labels::{Format, Known, LabelledRegion, import};
use serde_json::{Value, json};
use std::path::PathBuf;

#[path = "check_tests.rs"]
mod check_tests;

const QUAD: [[f64; 2]; 4] = [[10.25, 8.0], [90.0, 10.6], [89.75, 30.0], [10.0, 28.4]];
const HASH_OF_ABC: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";

fn word(quad: [[f64; 2]; 4], transcription: &str) -> SetWord {
    SetWord {
        id: 0,
        quad,
        polygon: quad.to_vec(),
        transcription: transcription.into(),
        script: None,
        ignore: false,
        visibility: 1.0,
        pose: None,
        cluster: None,
        characters: Vec::new(),
    }
}

fn upright(x: f64, y: f64, w: f64, h: f64) -> [[f64; 2]; 4] {
    [[x, y], [x + w, y], [x + w, y + h], [x, y + h]]
}

fn image(name: &str, words: Vec<SetWord>) -> SetImage {
    SetImage {
        image: name.into(),
        width: 100,
        height: 60,
        intrinsic: [80.5, 81.0, 50.0, 30.0],
        world_from_camera: [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 1.0, -2.0], [0.0, -1.0, 0.0, 0.25]],
        scene: "s01".into(),
        style: None,
        seed: None,
        words,
    }
}

/// `camera_from_region` of writing turned by half a turn about x and `angle` about z.
fn pose(angle: f64) -> WordPose {
    let (s, c) = angle.sin_cos();
    WordPose::new([[c, s, 0.0, 0.1], [s, -c, 0.0, -0.2], [0.0, 0.0, -1.0, 3.0]], [1.5, 0.4])
}

/// Two images with words and one without. The words of the first: read (curved, with a pose and characters), unreadable, to be ignored,
/// thinner than a pixel; of the second: at the image's border, in Han.
fn set() -> Vec<SetImage> {
    let mut curved = word(QUAD, "CAFE, \"2\"\tNo\n5");
    curved.polygon = vec![[10.25, 8.0], [50.0, 7.5], [90.0, 10.6], [89.75, 30.0], [50.0, 29.5], [10.0, 28.4]];
    (curved.id, curved.visibility, curved.script) = (4, 0.75, Some("Latin".into()));
    (curved.pose, curved.cluster) = (Some(pose(0.3)), Some(11));
    curved.characters = vec![SetCharacter { text: "C".into(), quad: upright(10.5, 8.5, 8.0, 19.0) }];
    let unreadable = word(upright(1.0, 40.0, 10.0, 5.0), UNREADABLE);
    let ignored = SetWord { ignore: true, ..word(upright(20.0, 40.0, 10.0, 5.0), "FAR") };
    let thin = word(upright(40.0, 40.1, 10.0, 0.3), "thin");
    let mut han = word([[-5e-7, 0.0], [100.0 + 5e-7, 0.4], [100.0, 60.0 + 5e-7], [0.0, 59.6]], "出口");
    (han.id, han.script) = (1, Some("Han".into()));
    let mut first = image("images/000000.png", vec![curved, unreadable, ignored, thin]);
    (first.style, first.seed) = (Some("winter".into()), Some(u64::MAX));
    vec![first, image("images/000001.jpg", vec![han]), image("images/000002.png", Vec::new())]
}

/// A folder with the set in all formats; each image file holds `abc`.
fn written() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    for image in set() {
        std::fs::write(dir.path().join(image.image), "abc").unwrap();
    }
    write(dir.path(), &set(), &SetFormat::ALL).unwrap();
    dir
}

fn text(dir: &tempfile::TempDir, place: &str) -> String {
    std::fs::read_to_string(dir.path().join(place)).unwrap()
}

fn json_of(dir: &tempfile::TempDir, place: &str) -> Value {
    serde_json::from_str(&text(dir, place)).unwrap()
}

fn known() -> Vec<Known> {
    set().into_iter().map(|i| Known { path: i.image, size: (i.width, i.height) }).collect()
}

/// Regions of the first and the second image as our importer reads them.
fn imported(dir: &tempfile::TempDir, format: Format, place: &str) -> [Vec<LabelledRegion>; 2] {
    let images = import(format, &dir.path().join(place), &known()).unwrap();
    assert_eq!(images.iter().map(|i| &i.image[..]).collect::<Vec<_>>(), ["images/000000.png", "images/000001.jpg"]);
    images.into_iter().map(|i| i.regions).collect::<Vec<_>>().try_into().unwrap()
}

fn texts(regions: &[LabelledRegion]) -> Vec<(&str, bool)> {
    regions.iter().map(|r| (&r.transcription[..], r.ignore)).collect()
}

/// The corners of the written coordinates of the image at the border.
const WHOLE: [[f64; 2]; 4] = [[0.0, 0.0], [100.0, 0.4], [100.0, 60.0], [0.0, 59.6]];

#[test]
fn annotations_are_read_as_they_were_saved() {
    let dir = tempfile::tempdir().unwrap();
    save(dir.path(), &set()).unwrap();
    assert_eq!(read(dir.path()).unwrap(), set());
    let lines = text(&dir, ANNOTATIONS);
    assert!(lines.lines().count() == 3 && !lines.contains("null"));
    std::fs::write(dir.path().join(ANNOTATIONS), format!("{EXAMPLE}\n\n")).unwrap();
    assert_eq!(read(dir.path()).unwrap()[0].intrinsic, [500.0, 500.0, 320.0, 240.0]);
}

#[test]
fn equal_annotations_give_equal_bytes() {
    fn all(folder: &Path, into: &mut Vec<(PathBuf, Vec<u8>)>, root: &Path) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => all(&path, into, root),
                false => into.push((path.strip_prefix(root).unwrap().into(), std::fs::read(&path).unwrap())),
            }
        }
        into.sort();
    }
    let [a, b] = [written(), written()].map(|dir| {
        save(dir.path(), &set()).unwrap();
        write(dir.path(), &set(), &SetFormat::ALL).unwrap();
        let mut files = Vec::new();
        all(dir.path(), &mut files, dir.path());
        files
    });
    assert_eq!(a, b);
    // 3 images, 3 × 3 lines, annotations, Label.txt, meta.json, and a file each of five formats: nothing partial is left.
    assert_eq!(a.len(), 3 + 9 + 3 + 5);
    let names: Vec<&str> = SetFormat::ALL.iter().map(|f| f.name()).collect();
    assert_eq!(serde_json::to_value(SetFormat::ALL).unwrap(), json!(names));
    assert!(SetFormat::ALL.iter().all(|f| SetFormat::named(f.name()) == Some(*f)) && SetFormat::named("voc").is_none());
}

#[test]
fn icdar_lines_are_integers_inside_of_the_image() {
    let dir = written();
    let [first, second] = imported(&dir, Format::Icdar15, "icdar15");
    let said = "CAFE, \"2\" No 5";
    assert_eq!(texts(&first), [(said, false), (UNREADABLE, true), (UNREADABLE, true)]);
    assert_eq!(first[0].polygon, [[10.0, 8.0], [90.0, 11.0], [90.0, 30.0], [10.0, 28.0]]);
    assert_eq!(second[0].polygon, [[0.0, 0.0], [100.0, 0.0], [100.0, 60.0], [0.0, 60.0]]);
    assert_eq!(text(&dir, "icdar15/gt_000001.txt"), "0,0,100,0,100,60,0,60,出口\n");
    let [mlt, han] = imported(&dir, Format::Mlt17, "mlt17");
    assert_eq!(texts(&mlt), texts(&first));
    assert!(mlt.iter().zip(&first).all(|(a, b)| a.polygon == b.polygon));
    assert!(mlt[0].script.as_deref() == Some("Latin") && mlt[1].script.as_deref() == Some("None"));
    assert!(han[0].script.as_deref() == Some("Chinese") && han[0].transcription == "出口");
    let [boxes, whole] = imported(&dir, Format::Icdar13, "icdar13");
    assert_eq!(texts(&boxes), texts(&first));
    assert_eq!(boxes[0].polygon, upright(10.0, 8.0, 80.0, 22.0));
    assert_eq!(whole[0].polygon, upright(0.0, 0.0, 100.0, 60.0));
    assert!(text(&dir, "icdar13/gt_000000.txt").ends_with("\n20 40 30 45 \"###\"\n"));
    for format in ["icdar13", "icdar15", "mlt17"] {
        assert_eq!(text(&dir, &format!("{format}/gt_000002.txt")), "");
    }
}

#[test]
fn quads_that_rounding_breaks_are_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let kept = [[1.0, 1.0], [4.4, 1.4], [4.0, 3.0], [1.0, 3.0]];
    let two_corners_meet = [[1.0, 1.0], [9.0, 1.2], [9.0, 1.4], [1.0, 3.0]];
    let sides_cross = [[0.0, 0.0], [10.0, 3.0], [4.6, 1.45], [0.0, 2.0]];
    let words = [kept, two_corners_meet, sides_cross].map(|q| word(q, "A")).to_vec();
    write(dir.path(), &[image("a.png", words)], &[SetFormat::Icdar15]).unwrap();
    assert_eq!(text(&dir, "icdar15/gt_a.txt"), "1,1,4,1,4,3,1,3,A\n");
    assert!(!dir.path().join("icdar13").exists() && !dir.path().join("Label.txt").exists());
}

#[test]
fn label_txt_holds_words_and_for_textnerf_poses() {
    let dir = written();
    let [first, second] = imported(&dir, Format::Ppocr, "Label.txt");
    assert_eq!(texts(&first), [("CAFE, \"2\"\tNo\n5", false), (UNREADABLE, true), (UNREADABLE, true), ("thin", false)]);
    assert!(first[0].polygon == QUAD && second[0].polygon == WHOLE);
    let lines = text(&dir, "Label.txt");
    let (name, list) = lines.lines().next().unwrap().split_once('\t').unwrap();
    let words: Value = serde_json::from_str(list).unwrap();
    let pose = pose(0.3);
    let expected = json!({
        "transcription": "CAFE, \"2\"\tNo\n5", "points": QUAD, "difficult": false, "text_pose": pose.text_pose,
        "quaternion": pose.quaternion, "axis_angle": pose.axis_angle, "size": [1.5, 0.4], "visibility": 0.75, "cluster": 11,
    });
    assert!(name == "images/000000.png" && lines.lines().count() == 3 && lines.ends_with("images/000002.png\t[]\n"));
    assert_eq!(words[0], expected);
    assert!(words[1]["text_pose"].is_null() && words[1]["cluster"].is_null() && words[2]["difficult"] == true);
    let meta = json_of(&dir, "meta.json");
    let expected = json!({
        "intrinsic": [[80.5, 0.0, 50.0], [0.0, 81.0, 30.0], [0.0, 0.0, 1.0]], "image_wh": [100, 60],
        "pose": set()[0].world_from_camera, "style": "winter", "scene": "s01", "seed": u64::MAX,
    });
    assert!(meta["images/000000.png"] == expected && meta["images/000001.jpg"]["style"].is_null());
    assert_eq!(meta.as_object().unwrap().len(), 3);
    // Without poses, whatever the order of the formats.
    let plain = tempfile::tempdir().unwrap();
    write(plain.path(), &set(), &[SetFormat::Ppocr]).unwrap();
    assert!(!plain.path().join("meta.json").exists() && !text(&plain, "Label.txt").contains("text_pose"));
    assert_eq!(texts(&imported(&plain, Format::Ppocr, "Label.txt")[0]), texts(&first));
    write(plain.path(), &set(), &[SetFormat::TextNerf, SetFormat::Ppocr]).unwrap();
    assert_eq!(text(&plain, "Label.txt"), lines);
}

#[test]
fn mmocr_holds_polygons_boxes_and_ignored_words() {
    let all = json_of(&written(), "mmocr/textdet.json");
    let metainfo = json!({"dataset_type": "TextDetDataset", "task_name": "textdet", "category": [{"id": 0, "name": "text"}]});
    assert_eq!(all["metainfo"], metainfo);
    let list = all["data_list"].as_array().unwrap();
    assert!(list.len() == 3 && list[2]["instances"] == json!([]));
    assert!(list[1]["img_path"] == "images/000001.jpg" && list[1]["height"] == 60 && list[1]["width"] == 100);
    let expected = json!({
        "polygon": [10.25, 8.0, 50.0, 7.5, 90.0, 10.6, 89.75, 30.0, 50.0, 29.5, 10.0, 28.4], "bbox": [10.0, 7.5, 90.0, 30.0],
        "bbox_label": 0, "ignore": false, "text": "CAFE, \"2\"\tNo\n5",
    });
    assert_eq!(list[0]["instances"][0], expected);
    let ignored: Vec<&Value> = list[0]["instances"].as_array().unwrap().iter().map(|i| &i["ignore"]).collect();
    assert_eq!(ignored, [false, true, true, false]);
    assert_eq!(list[1]["instances"][0]["bbox"], json!([0.0, 0.0, 100.0, 60.0]));
}

#[test]
fn doctr_holds_read_words_of_hashed_images() {
    let dir = written();
    let labels = json_of(&dir, "doctr/labels.json");
    assert_eq!(labels.as_object().unwrap().keys().collect::<Vec<_>>(), ["000000.png", "000001.jpg"]);
    let thin = upright(40.0, 40.1, 10.0, 0.3);
    let expected = json!({"img_dimensions": [100, 60], "img_hash": HASH_OF_ABC, "polygons": [QUAD, thin]});
    assert_eq!(labels["000000.png"], expected);
    assert_eq!(labels["000001.jpg"]["polygons"], json!([WHOLE]));
    std::fs::remove_file(dir.path().join("images/000001.jpg")).unwrap();
    let error = write(dir.path(), &set(), &[SetFormat::Doctr]).unwrap_err().to_string();
    assert!(error.contains("images/000001.jpg: ") && error.contains("write them first"), "{error}");
}

#[test]
fn coco_holds_segmentations_crowds_and_characters() {
    let all = json_of(&written(), "coco/instances.json");
    assert_eq!(all["categories"], json!([{"id": 1, "name": "text", "supercategory": "text"}]));
    assert_eq!(all["images"][1], json!({"id": 2, "file_name": "images/000001.jpg", "width": 100, "height": 60}));
    let annotations = all["annotations"].as_array().unwrap();
    let numbers = |key: &str| annotations.iter().map(|a| a[key].as_u64().unwrap()).collect::<Vec<_>>();
    assert_eq!(numbers("id"), [1, 2, 3, 4, 5]);
    assert_eq!(numbers("image_id"), [1, 1, 1, 1, 2]);
    assert_eq!(numbers("iscrowd"), [0, 1, 1, 0, 0]);
    let first = &annotations[0];
    assert_eq!(first["segmentation"], json!([[10.25, 8.0, 50.0, 7.5, 90.0, 10.6, 89.75, 30.0, 50.0, 29.5, 10.0, 28.4]]));
    assert_eq!(first["bbox"], json!([10.0, 7.5, 80.0, 22.5]));
    assert!(first["category_id"] == 1 && first["text"] == "CAFE, \"2\"\tNo\n5");
    assert_eq!(first["characters"], json!([{"text": "C", "quad": [10.5, 8.5, 18.5, 8.5, 18.5, 27.5, 10.5, 27.5]}]));
    assert_eq!((&annotations[1]["area"], &annotations[1]["bbox"]), (&json!(50.0), &json!([1.0, 40.0, 10.0, 5.0])));
    assert!((annotations[4]["area"].as_f64().unwrap() - 5960.0).abs() < 1e-9);
}

#[test]
fn coco_text_and_textocr_index_words_by_image() {
    let dir = written();
    let all = json_of(&dir, "coco_text/cocotext.json");
    assert!(["cats", "info"].iter().all(|k| all[k].is_object()));
    assert_eq!(all["imgToAnns"], json!({"1": [1, 2, 3, 4], "2": [5], "3": []}));
    let expected = json!({"id": 2, "file_name": "images/000001.jpg", "width": 100, "height": 60, "set": "train"});
    assert_eq!(all["imgs"]["2"], expected);
    let expected = json!({
        "id": 3, "image_id": 1, "mask": [20.0, 40.0, 30.0, 40.0, 30.0, 45.0, 20.0, 45.0], "bbox": [20.0, 40.0, 10.0, 5.0], "area": 50.0,
        "utf8_string": "", "legibility": "illegible", "class": "machine printed", "language": "na",
    });
    assert_eq!(all["anns"]["3"], expected);
    let said = |id: &str| ["utf8_string", "legibility", "language"].map(|k| all["anns"][id][k].as_str().unwrap());
    assert_eq!(said("4"), ["thin", "legible", "english"]);
    assert_eq!(said("5"), ["出口", "legible", "not english"]);
    let all = json_of(&dir, "textocr/textocr.json");
    let ids = json!({"000000": ["000000_1", "000000_2", "000000_3", "000000_4"], "000001": ["000001_1"], "000002": []});
    assert_eq!(all["imgToAnns"], ids);
    let expected = json!({"id": "000001", "file_name": "images/000001.jpg", "width": 100, "height": 60, "set": "train"});
    assert_eq!(all["imgs"]["000001"], expected);
    let expected = json!({
        "id": "000001_1", "image_id": "000001", "bbox": [0.0, 0.0, 100.0, 60.0], "utf8_string": "出口",
        "points": [0.0, 0.0, 100.0, 0.4, 100.0, 60.0, 0.0, 59.6], "area": 6000.0,
    });
    assert_eq!(all["anns"]["000001_1"], expected);
    let strings: Vec<&Value> = all["anns"].as_object().unwrap().values().map(|a| &a["utf8_string"]).collect();
    assert_eq!(strings, ["CAFE, \"2\"\tNo\n5", ".", ".", "thin", "出口"]);
}

#[test]
fn poses_say_their_rotation_in_three_ways() {
    // Half a turn about x, then a turn about z: half a turn about the axis between.
    let p = pose(0.3);
    let axis = [0.15f64.cos(), 0.15f64.sin(), 0.0];
    assert!(p.quaternion[0].abs() < 1e-12 && (0..3).all(|i| (p.quaternion[i + 1].abs() - axis[i].abs()).abs() < 1e-12));
    assert!((0..3).all(|i| (p.axis_angle[i].abs() - axis[i].abs() * std::f64::consts::PI).abs() < 1e-9));
    let (s, c) = 2.5f64.sin_cos();
    let about_y = WordPose::new([[c, 0.0, s, 0.0], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 0.0]], [1.0, 1.0]);
    let expected = [1.25f64.cos(), 0.0, 1.25f64.sin(), 0.0];
    assert!((0..4).all(|i| (about_y.quaternion[i] - expected[i]).abs() < 1e-12), "{about_y:?}");
    assert!((about_y.axis_angle[1] - 2.5).abs() < 1e-12);
    let still = WordPose::new([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], [1.0, 1.0]);
    assert!(still.quaternion == [1.0, 0.0, 0.0, 0.0] && still.axis_angle == [0.0; 3]);
}

#[test]
fn what_is_removed_is_what_was_written_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let set = set();
    for image in &set {
        put(folder, &image.image, b"abc").unwrap();
    }
    put(folder, "images/mine.txt", b"mine").unwrap();
    put(folder, "icdar15/gt_mine.txt", b"mine").unwrap();
    save(folder, &set).unwrap();
    write(folder, &set, &SetFormat::ALL).unwrap();
    remove(folder, &set).unwrap();
    let mut left = Vec::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(at) = folders.pop() {
        for entry in std::fs::read_dir(at).unwrap().map(|e| e.unwrap().path()) {
            if entry.is_dir() { folders.push(entry) } else { left.push(entry.strip_prefix(folder).unwrap().to_path_buf()) }
        }
    }
    left.sort();
    assert_eq!(left, [PathBuf::from("icdar15/gt_mine.txt"), PathBuf::from("images/mine.txt")]);
    remove(folder, &set).unwrap();
}
