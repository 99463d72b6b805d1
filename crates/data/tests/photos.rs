//! Photographs of every format: truncated files are refused, and the full range of values is kept.

use diorama_data::photo::{self, Photo};
use diorama_geom::Image;
use image::{DynamicImage, ImageBuffer, ImageFormat};
use std::io::Cursor;
use std::path::{Path, PathBuf};

const SIZE: (u32, u32) = (13, 9);

fn noise(x: u32, y: u32, k: u32) -> u32 {
    (x * 7919 + y * 104_729 + k * 1_299_709).wrapping_mul(2_654_435_761) >> 8
}

fn encode(im: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    im.write_to(&mut out, format).unwrap();
    out.into_inner()
}

fn eight() -> DynamicImage {
    DynamicImage::ImageRgb8(ImageBuffer::from_fn(SIZE.0, SIZE.1, |x, y| image::Rgb([0, 1, 2].map(|k| noise(x, y, k) as u8))))
}

fn sixteen() -> DynamicImage {
    DynamicImage::ImageRgb16(ImageBuffer::from_fn(SIZE.0, SIZE.1, |x, y| image::Rgb([0, 1, 2].map(|k| noise(x, y, k) as u16))))
}

fn linear() -> DynamicImage {
    let pixel = |x, y| image::Rgb([0, 1, 2].map(|k| noise(x, y, k) as u16 as f32 / 256.0));
    DynamicImage::ImageRgb32F(ImageBuffer::from_fn(SIZE.0, SIZE.1, pixel))
}

/// One file of each kind, by name.
fn files() -> Vec<(&'static str, Vec<u8>)> {
    vec![
        ("baseline.jpg", include_bytes!("photos/baseline.jpg").to_vec()),
        ("encoded.jpg", encode(&eight(), ImageFormat::Jpeg)),
        ("progressive.jpg", include_bytes!("photos/progressive.jpg").to_vec()),
        ("8.png", encode(&eight(), ImageFormat::Png)),
        ("16.png", encode(&sixteen(), ImageFormat::Png)),
        ("lossless.webp", encode(&eight(), ImageFormat::WebP)),
        ("lossy.webp", include_bytes!("photos/lossy.webp").to_vec()),
        ("8.tiff", encode(&eight(), ImageFormat::Tiff)),
        ("16.tiff", encode(&sixteen(), ImageFormat::Tiff)),
        ("lzw.tiff", include_bytes!("photos/lzw.tiff").to_vec()),
        ("deflate.tiff", include_bytes!("photos/deflate.tiff").to_vec()),
        ("linear.exr", encode(&linear(), ImageFormat::OpenExr)),
        ("linear.hdr", encode(&linear(), ImageFormat::Hdr)),
    ]
}

fn saved(dir: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = dir.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn what_is_cut_off_anywhere_is_refused_by_name_unless_nothing_is_lost() {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files() {
        let whole = photo::load_full(&saved(dir.path(), name, &bytes)).unwrap();
        let mut refused = 0;
        // Every length near the end, where little is lost, and a third of the other lengths.
        for n in (0..bytes.len()).filter(|n| n % 3 == 0 || n + 200 > bytes.len()) {
            match photo::load_full(&saved(dir.path(), name, &bytes[..n])) {
                Ok(cut) => assert!(cut == whole, "{name} of {n} of {} bytes decodes to something else", bytes.len()),
                Err(e) => {
                    let text = e.to_string();
                    assert!(e.is_input() && text.contains(name) && text.contains("--skip-broken") && !text.contains('\n'), "{text}");
                    refused += 1;
                    continue;
                }
            }
            assert!(n * 10 >= bytes.len() * 9, "{name}: {n} of {} bytes are enough", bytes.len());
        }
        println!("{name}: {refused} of {} lengths refused", bytes.len());
    }
}

#[test]
fn a_jpeg_whose_tail_is_zeros_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files().into_iter().filter(|f| f.0.ends_with("jpg")) {
        for n in [bytes.len() / 2, bytes.len() * 9 / 10] {
            let mut cut = bytes.clone();
            cut[n..].fill(0);
            assert!(photo::load_full(&saved(dir.path(), name, &cut)).is_err(), "{name}, zeros from {n}");
        }
    }
}

#[test]
fn a_jpeg_without_its_end_marker_is_whole_if_its_data_are() {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files().into_iter().filter(|f| f.0.ends_with("jpg")) {
        let whole = photo::load_full(&saved(dir.path(), name, &bytes)).unwrap();
        let without = saved(dir.path(), name, &bytes[..bytes.len() - 2]);
        assert_eq!(photo::load_full(&without).unwrap(), whole, "{name}");
        let beyond = saved(dir.path(), name, &[&bytes[..], b"what a phone appends"].concat());
        assert_eq!(photo::load_full(&beyond).unwrap(), whole, "{name}");
    }
}

/// The folder of real captures; without one, prints that the test was skipped.
fn data(name: &str) -> Option<PathBuf> {
    let found = std::env::var("DIORAMA_TEST_DATA").ok().map(|d| PathBuf::from(d).join(name)).filter(|d| d.is_dir());
    if found.is_none() {
        assert!(std::env::var("DIORAMA_REQUIRE_DATA").is_err(), "DIORAMA_TEST_DATA/{name} is required");
        println!("skipped: no test data");
    }
    found
}

#[test]
fn real_photographs_are_whole_until_they_are_cut_off() {
    let Some(fox) = data("fox") else { return };
    let dir = tempfile::tempdir().unwrap();
    let photos = diorama_data::photo_import::list(&fox.join("images")).unwrap();
    for file in &photos {
        let bytes = std::fs::read(file).unwrap();
        photo::load_full(file).unwrap();
        for n in [500, bytes.len() / 2, bytes.len() * 9 / 10, bytes.len() - 100] {
            let e = photo::load_full(&saved(dir.path(), "cut.jpg", &bytes[..n])).unwrap_err().to_string();
            assert!(e.contains("cut.jpg") && e.contains("--skip-broken"), "{e}");
        }
    }
    // The same without end markers, which makes the check count the data.
    let bytes = std::fs::read(&photos[0]).unwrap();
    let end = bytes.windows(2).rposition(|w| w == [0xff, 0xd9]).unwrap();
    assert!(photo::load_full(&saved(dir.path(), "whole.jpg", &bytes[..end])).is_ok());
}

#[test]
fn sixteen_bits_come_back_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files().into_iter().filter(|f| f.0.starts_with("16")) {
        let Photo::Sixteen(im) = photo::load_full(&saved(dir.path(), name, &bytes)).unwrap() else { panic!("{name}") };
        let want = sixteen().into_rgb16().into_raw();
        let got: Vec<u16> = im.data.iter().map(|v| diorama_geom::color::u16_from_unit(*v)).collect();
        assert_eq!(got, want, "{name}");
    }
}

#[test]
fn exr_and_hdr_keep_what_is_brighter_than_white() {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files().into_iter().filter(|f| f.0.starts_with("linear")) {
        let Photo::Linear(im) = photo::load_full(&saved(dir.path(), name, &bytes)).unwrap() else { panic!("{name}") };
        let want = linear().into_rgb32f().into_raw();
        assert!(want.iter().any(|v| *v > 100.0));
        // HDR shares one exponent among the channels of a pixel.
        for (got, want) in im.data.chunks_exact(3).zip(want.chunks_exact(3)) {
            let most = want.iter().fold(0.0f32, |a, b| a.max(*b));
            assert!(got.iter().zip(want).all(|(a, b)| (a - b).abs() <= most / 128.0), "{name}: {got:?} for {want:?}");
        }
        assert_eq!(photo::header(&dir.path().join(name)).unwrap().color_space(), diorama_geom::capture::ColorSpace::Linear);
    }
}

#[test]
fn a_value_that_is_not_a_number_is_told_with_its_pixel() {
    let dir = tempfile::tempdir().unwrap();
    for (value, word) in [(f32::NAN, "not a number"), (f32::INFINITY, "inf"), (1e6, "1000000")] {
        let mut im = linear().into_rgb32f();
        im.get_pixel_mut(5, 7)[1] = value;
        let path = saved(dir.path(), "bad.exr", &encode(&DynamicImage::ImageRgb32F(im), ImageFormat::OpenExr));
        let e = photo::load_full(&path).unwrap_err();
        let text = e.to_string();
        assert!(e.is_input() && text.contains("bad.exr") && text.contains("(5, 7)") && text.contains(word), "{text}");
        assert!(text.contains("green") && !text.contains('\n'), "{text}");
    }
}

#[test]
fn transparent_exr_is_multiplied_by_alpha_in_the_file_only() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.exr");
    let im = Image { width: 2, height: 1, channels: 4, data: vec![4.0, 2.0, 0.5, 0.25, 0.0, 0.0, 0.0, 0.0] };
    photo::save_exr(&path, &im).unwrap();
    assert_eq!(photo::load_full(&path).unwrap(), Photo::Linear(im));
}
