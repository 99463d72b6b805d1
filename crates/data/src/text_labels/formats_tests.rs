use super::*;

fn known() -> Vec<Known> {
    ["images/001.png", "images/002.png", "images/010.jpg"].map(|p| Known { path: p.into(), size: (100, 60) }).to_vec()
}

/// A folder with files.
fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for (name, text) in files {
        std::fs::write(dir.path().join(name), text).unwrap();
    }
    dir
}

fn imported(format: Format, files: &[(&str, &str)]) -> Vec<LabelledImage> {
    import(format, folder(files).path(), &known()).unwrap()
}

#[track_caller]
fn refused(format: Format, files: &[(&str, &str)], expected: &[&str]) {
    let error = import(format, folder(files).path(), &known()).unwrap_err().to_string();
    assert!(expected.iter().all(|e| error.contains(e)), "{expected:?} are not all in {error:?}");
    assert_eq!(error.lines().count(), 1);
}

const QUAD: [[f64; 2]; 4] = [[10.0, 8.0], [90.0, 10.0], [90.0, 30.0], [10.0, 28.0]];

#[test]
fn every_format_says_the_same() {
    let labelme = |image: &str, order: &str| {
        format!(
            r#"{{"version":"5","imagePath":"../images/{image}","shapes":[{{"label":"CAFE, 2","points":{order},"group_id":4,"shape_type":"polygon"}}]}}"#
        )
    };
    let clockwise = "[[10,8],[90,10],[90,30],[10,28]]";
    let counter = "[[10,8],[10,28],[90,30],[90,10]]";
    let of_labelme = imported(Format::Labelme, &[("a.json", &labelme("002.png", counter)), ("b.json", &labelme("001.png", clockwise))]);
    let ppocr = format!(
        "x/001.png\t[{{\"transcription\":\"CAFE, 2\",\"points\":{clockwise},\"difficult\":false}}]\nx/002.png\t[{{\"transcription\":\"CAFE, 2\",\"points\":{clockwise}}}]\n"
    );
    let of_ppocr = imported(Format::Ppocr, &[("Label.txt", &ppocr)]);
    let line = "10,8,90,10,90,30,10,28,CAFE, 2\r\n";
    let of_icdar15 = imported(Format::Icdar15, &[("gt_001.txt", &format!("\u{feff}{line}")), ("002.txt", line)]);
    let line = "10,8,90,10,90,30,10,28,Latin,CAFE, 2\n";
    let of_mlt = imported(Format::Mlt17, &[("gt_001.txt", line), ("gt_002.txt", line)]);
    for all in [&of_labelme, &of_ppocr, &of_icdar15, &of_mlt] {
        assert_eq!(all.iter().map(|i| &i.image[..]).collect::<Vec<_>>(), ["images/001.png", "images/002.png"]);
        for image in all.iter() {
            let r = &image.regions[0];
            assert!(r.polygon == QUAD && r.transcription == "CAFE, 2" && !r.ignore && r.id == all[0].regions[0].id, "{r:?}");
        }
    }
    assert!(of_labelme[0].regions[0].id == 4 && of_mlt[1].regions[0].script.as_deref() == Some("Latin"));
    let boxes = imported(Format::Icdar13, &[("gt_010.txt", "10 8 90 30 \"say \"hi\"\"\n1, 2, 30, 20, \"B\"\n")]);
    assert_eq!(boxes[0].image, "images/010.jpg");
    assert_eq!(boxes[0].regions[0].polygon, [[10.0, 8.0], [90.0, 8.0], [90.0, 30.0], [10.0, 30.0]]);
    assert!(boxes[0].regions[0].transcription == "say \"hi\"" && boxes[0].regions[1].transcription == "B");
}

#[test]
fn regions_without_ids_are_told_apart_and_unreadable_ones_are_ignored() {
    let a = "0,0,20,0,20,10,0,10,SALE\n0,20,20,20,20,30,0,30,SALE\n40,0,60,0,60,10,40,10,###\n40,20,60,20,60,30,40,30,OPEN\n";
    let b = "1,0,21,0,21,10,1,10,OPEN\n1,20,21,20,21,30,1,30,SALE\n41,0,61,0,61,10,41,10,###\n";
    let all = imported(Format::Icdar15, &[("gt_001.txt", a), ("gt_002.txt", b)]);
    let id = |i: usize, r: usize| all[i].regions[r].id;
    assert!(id(0, 0) == id(1, 1) && id(0, 3) == id(1, 0) && id(0, 0) != id(0, 1) && id(0, 2) != id(1, 2));
    assert!(all[0].regions[2].ignore && !all[0].regions[0].ignore && all[0].regions[2].transcription == UNREADABLE);
    let rectangle =
        r#"{"imagePath":"001.png","shapes":[{"label":"A","points":[[30,20],[10,5]],"group_id":null,"shape_type":"rectangle"}]}"#;
    assert_eq!(
        imported(Format::Labelme, &[("a.json", rectangle)])[0].regions[0].polygon,
        [[10.0, 5.0], [30.0, 5.0], [30.0, 20.0], [10.0, 20.0]]
    );
}

#[test]
fn one_image_in_several_places_is_one_and_names_may_have_dots() {
    let line =
        |text: &str, x: u32| format!("001.png\t[{{\"transcription\":\"{text}\",\"points\":[[{x},1],[{},1],[{},9]]}}]\n", x + 5, x + 5);
    let all = imported(Format::Ppocr, &[("Label.txt", &(line("A", 1) + &line("A", 20) + &line("B", 40)))]);
    assert!(all.len() == 1 && all[0].regions.len() == 3);
    let ids: Vec<u32> = all[0].regions.iter().map(|r| r.id).collect();
    assert!(ids[0] != ids[1] && ids[1] != ids[2] && ids[0] != ids[2]);
    let dotted = [Known { path: "images/a.b.jpg".into(), size: (100, 60) }];
    let dir = folder(&[("gt_a.b.txt", "1,1,9,1,9,9,1,9,A\n")]);
    assert_eq!(import(Format::Icdar15, dir.path(), &dotted).unwrap()[0].image, "images/a.b.jpg");
}

#[test]
fn errors_name_file_line_and_what_is_expected() {
    refused(
        Format::Icdar15,
        &[("gt_001.txt", "1,1,9,1,9,9,1,9,A\n1,1,9,1,9,9,A\n")],
        &["gt_001.txt: line 2: 7 fields; expected x1,y1", "y4,text"],
    );
    refused(Format::Mlt17, &[("gt_001.txt", "1,1,9,1,9,9,1,9,A\n")], &["line 1: 9 fields", "y4,script,text"]);
    refused(Format::Icdar15, &[("gt_001.txt", "1,1,9,x,9,9,1,9,A\n")], &["line 1: \"x\" is not a number"]);
    refused(Format::Icdar13, &[("gt_001.txt", "1 1 9 A\n")], &["line 1", "expected left top right bottom \"text\""]);
    refused(Format::Ppocr, &[("Label.txt", "001.png []\n")], &["Label.txt: line 1: no tab", "expected PATH, a tab"]);
    refused(Format::Labelme, &[("a.json", "{\"shapes\":[]}")], &["a.json", "missing field `imagePath`"]);
    refused(
        Format::Icdar15,
        &[("gt_003.txt", "1,1,9,1,9,9,1,9,A\n")],
        &["gt_003.txt", "labels \"003\", which is no photograph", "images/001.png"],
    );
    refused(Format::Icdar15, &[("gt_001.txt", "1,1,9,9,9,1,3,9,A\n")], &["line 1: the side after vertex 0 crosses"]);
    refused(
        Format::Icdar15,
        &[("gt_001.txt", "1,1,109,1,109,9,1,9,A\n")],
        &["line 1: vertex 1 at 109, 1 is outside of the photograph of 100×60"],
    );
    let two = |id: u32| {
        format!(
            r#"{{"imagePath":"00{id}.png","shapes":[{{"label":"{}","points":[[1,1],[9,1],[9,9]],"group_id":7}}]}}"#,
            ["A", "B"][id as usize - 1]
        )
    };
    refused(
        Format::Labelme,
        &[("a.json", &two(1)), ("b.json", &two(2))],
        &["b.json, shape 0: region 7 is \"B\"", "at a.json, shape 0 it is \"A\""],
    );
    let twice = r#"{"imagePath":"001.png","shapes":[{"label":"A","points":[[1,1],[9,1],[9,9]],"group_id":7},{"label":"A","points":[[1,1],[9,1],[9,9]],"group_id":7}]}"#;
    refused(Format::Labelme, &[("a.json", twice)], &["shape 1: region 7 is labelled twice in images/001.png"]);
    let largest = r#"{"imagePath":"001.png","shapes":[{"label":"A","points":[[1,1],[9,1],[9,9]],"group_id":4294967295},{"label":"B","points":[[1,1],[9,1],[9,9]]}]}"#;
    refused(Format::Labelme, &[("a.json", largest)], &["shape 1: an id is as large as ids can be"]);
    let two = ["cam0/001.png", "cam1/001.png"].map(|p| Known { path: p.into(), size: (100, 60) });
    let dir = folder(&[("gt_001.txt", "1,1,9,1,9,9,1,9,A\n")]);
    let error = import(Format::Icdar15, dir.path(), &two).unwrap_err().to_string();
    assert!(error.contains("may be \"cam0/001.png\" or \"cam1/001.png\""), "{error}");
    refused(Format::Icdar15, &[("readme.md", "")], &["holds no gt_NAME.txt, as icdar15 has"]);
    refused(
        Format::Icdar15,
        &[("gt_001.txt", "\n")],
        &["holds no label of the format icdar15; label at least one region, as in 10,8,90,10,90,30,10,28,CAFE"],
    );
    let missing = tempfile::tempdir().unwrap().path().join("none");
    assert!(import(Format::Ppocr, &missing, &known()).unwrap_err().to_string().contains("give a file or folder of labels"));
    assert!(Format::ALL.iter().all(|f| Format::named(f.name()) == Some(*f)) && Format::named("voc").is_none());
}
