use super::*;

fn face(fonts: &Fonts, family: &str) -> Face {
    fonts.latin().into_iter().find(|f| f.family == family).expect("a shipped family")
}

#[test]
fn all_shipped_fonts_are_latin_and_draw_different_letters() {
    let mut fonts = Fonts::shipped();
    let faces = fonts.latin();
    assert_eq!(faces.len(), 5, "{faces:?}");
    let mut inks: Vec<ImageU8> = faces.iter().map(|f| fonts.set("Quay 7", f, 48.0).unwrap().ink).collect();
    inks.dedup();
    assert_eq!(inks.len(), 5);
}

#[test]
fn bounds_hold_the_ink_of_each_character_and_word_and_nothing_else() {
    let mut fonts = Fonts::shipped();
    let face = face(&fonts, "Allerta");
    let set = fonts.set("Oil tin\nHEW", &face, 64.0).unwrap();
    assert_eq!(set.words.iter().map(|w| &w.text[..]).collect::<Vec<_>>(), ["Oil", "tin", "HEW"]);
    assert_eq!(set.characters.iter().map(|c| &c.text[..]).collect::<String>(), "OiltinHEW");
    // Every inked pixel is in some character, characters are in their word, and no row or column of a bound is without ink.
    let inside = |b: &Bounds, x: usize, y: usize| {
        (b.low[0] - 1.0..b.high[0]).contains(&(x as f32)) && (b.low[1] - 1.0..b.high[1]).contains(&(y as f32))
    };
    for (i, _) in set.ink.data.iter().enumerate().filter(|(_, v)| **v > 128) {
        let (x, y) = (i % set.ink.width, i / set.ink.width);
        assert!(set.characters.iter().any(|c| inside(&c.bounds, x, y)), "({x}, {y})");
    }
    // No bound is larger than its ink: at each of its sides there is some, and characters of a word do not share bounds.
    for b in set.characters.iter().map(|c| &c.bounds) {
        let inked = |x: std::ops::Range<f32>, y: std::ops::Range<f32>| {
            let w = set.ink.width;
            let pixels = set.ink.data.iter().enumerate().filter(|(_, v)| **v > 20);
            pixels.into_iter().any(|(i, _)| x.contains(&((i % w) as f32 + 0.5)) && y.contains(&((i / w) as f32 + 0.5)))
        };
        let ([x0, y0], [x1, y1]) = (b.low, b.high);
        let (x, y) = (x0 - 0.5..x1 + 0.5, y0 - 0.5..y1 + 0.5);
        assert!(
            inked(x0 - 0.5..x0 + 1.5, y.clone())
                && inked(x1 - 1.5..x1 + 0.5, y)
                && inked(x.clone(), y0 - 0.5..y0 + 1.5)
                && inked(x, y1 - 1.5..y1 + 0.5),
            "{b:?}"
        );
    }
    let letters: Vec<&Piece> = set.characters.iter().filter(|c| "HEW".contains(&c.text)).collect();
    assert!(letters.windows(2).all(|l| l[0].bounds.high[0] < l[1].bounds.low[0] + 2.0));
    for word in &set.words {
        let own = set.characters.iter().filter(|c| word.bytes.contains(&c.bytes.start));
        assert_eq!(own.fold(Bounds::NONE, |all, c| all.with(c.bounds)), word.bounds);
    }
    let all = set.words.iter().fold(Bounds::NONE, |all, w| all.with(w.bounds));
    assert!(all.low.iter().all(|v| (0.0..1.0).contains(v)));
    assert!((all.high[0] - set.ink.width as f32).abs() < 1.0 && (all.high[1] - set.ink.height as f32).abs() < 1.0);
    // The second line is below the first, left words are left of right ones, capitals are as high as each other.
    let b = |k: usize| set.words[k].bounds;
    assert!(b(0).high[0] < b(1).low[0] && b(0).high[1] < b(2).low[1]);
    let heights: Vec<f32> = set.characters.iter().filter(|c| "HEW".contains(&c.text)).map(|c| c.bounds.high[1] - c.bounds.low[1]).collect();
    assert!(heights.iter().all(|h| (h - heights[0]).abs() < 0.6) && heights[0] > 30.0, "{heights:?}");
}

#[test]
fn letters_that_share_a_glyph_are_one_piece_and_sizes_scale() {
    let mut fonts = Fonts::shipped();
    let face = face(&fonts, "Arapey");
    let [small, large] = [32.0, 96.0].map(|px| fonts.set("Ayr", &face, px).unwrap());
    let ratio = large.words[0].bounds.high[0] / small.words[0].bounds.high[0];
    assert!((ratio - 3.0).abs() < 0.1, "{ratio}");
    let shared = clusters(&[0..1, 1..3, 2..3, 3..4].map(|bytes| Drawn { bytes, left: 0, top: 0, width: 1, ink: vec![] }));
    assert_eq!(shared, [0..1, 1..3, 3..4]);
}

#[test]
fn characters_without_a_font_are_named() {
    let mut fonts = Fonts::shipped();
    let face = face(&fonts, "Sora");
    let lacking = fonts.set("Cafe \u{5e02}\u{0e01}", &face, 32.0).unwrap_err();
    let error = lacking.to_string();
    assert!(lacking.is_input());
    assert!(error.contains("U+0E01") && error.contains("(Thai)") && error.contains("U+5E02") && error.contains("(Han)"), "{error}");
    let error = fonts.set(" \n ", &face, 32.0).unwrap_err().to_string();
    assert!(error.contains("nothing of it has ink"), "{error}");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("x.ttf");
    std::fs::write(&file, b"no font").unwrap();
    let error = fonts.add(&file).unwrap_err().to_string();
    assert!(error.contains("x.ttf: holds no font"), "{error}");
}
