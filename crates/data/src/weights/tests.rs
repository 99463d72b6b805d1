//! Reads files that PyTorch wrote, truncated files, and hostile ones.

use super::number::half;
use super::*;
use std::path::PathBuf;

/// Made with PyTorch 2 by benches/peers/lpips_reference.py.
fn sample(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

#[test]
fn both_formats_of_torch_save_are_read() {
    for name in ["small.pth", "small_legacy.pth"] {
        let tensors = read(&sample(name), &|_| true).unwrap();
        let names: Vec<&str> = tensors.iter().map(|t| &t.name[..]).collect();
        // Integer tensors are not weights.
        let expected = ["0.weight", "0.bias", "1.weight", "1.bias", "1.running_mean", "1.running_var", "half", "brain", "double", "part"];
        assert_eq!(names, expected, "{name}");
        let by = |n: &str| tensors.iter().find(|t| t.name == n).unwrap();
        assert_eq!(by("0.weight").shape, [3, 2, 2, 2]);
        assert_eq!(by("0.weight").values[..4], [-1.0, -0.932_165_15, -0.502_243_9, -0.621_745_6]);
        assert_eq!(by("1.running_var").values, [0.836_628_56, 0.400_305_15, -0.595_174_8]);
        assert_eq!(by("half").values, [1.0, -0.5, 65504.0, 5.960_464_5e-8]);
        assert_eq!(by("brain").values, [1.0, -2.5]);
        assert_eq!(by("double").values, [0.1]);
        assert_eq!(by("part").values, [4.0, 5.0, 6.0], "a part of a longer storage");
        assert_eq!(read(&sample(name), &|n| n == "part").unwrap(), [by("part").clone()]);
    }
}

#[test]
fn safetensors_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let data: Vec<u8> = [1.5f32, -2.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let view = safetensors::tensor::TensorView::new(Dtype::F32, vec![2, 1], &data).unwrap();
    let path = dir.path().join("a.safetensors");
    std::fs::write(&path, safetensors::serialize([("w", view)], None).unwrap()).unwrap();
    assert_eq!(read(&path, &|_| true).unwrap(), [NamedArray { name: "w".into(), shape: vec![2, 1], values: vec![1.5, -2.0] }]);
}

#[test]
fn files_that_end_early_or_are_something_else_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.pth");
    for name in ["small.pth", "small_legacy.pth"] {
        let whole = std::fs::read(sample(name)).unwrap();
        for n in (0..whole.len()).step_by(7) {
            std::fs::write(&path, &whole[..n]).unwrap();
            let e = read(&path, &|_| true).unwrap_err();
            assert!(e.is_input() && e.to_string().contains("a.pth"), "{name} {n}: {e}");
        }
    }
    std::fs::write(&path, b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.").unwrap();
    assert!(read(&path, &|_| true).is_err());
}

#[test]
fn tensors_beyond_their_storage_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.pth");
    let whole = std::fs::read(sample("small_legacy.pth")).unwrap();
    // The tensor `part` has three of its storage's ten numbers, starting at number 4.
    let at = whole.windows(6).position(|w| w == b"K\x04K\x03\x85q").unwrap();
    for (i, v) in [(1, 200u8), (3, 9)] {
        let mut bad = whole.clone();
        bad[at + i] = v;
        std::fs::write(&path, bad).unwrap();
        let e = read(&path, &|_| true).unwrap_err().to_string();
        assert!(e.contains("part") && e.contains("beyond"), "{e}");
    }
}

#[test]
fn halves_are_exact() {
    for (bits, value) in [(0x3c00, 1.0f32), (0xc000, -2.0), (0x7bff, 65504.0), (1, 2f32.powi(-24)), (0x7c00, f32::INFINITY)] {
        assert_eq!(half(bits), value);
    }
    assert!(half(0x7e00).is_nan());
}

#[test]
fn what_is_saved_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.safetensors");
    let arrays =
        [NamedArray::new("a.weight", &[2, 3], vec![1.0, -0.0, f32::MIN_POSITIVE, 4.0, 5.0, 6.0]), NamedArray::new("b", &[0], vec![])];
    save(&path, &arrays, HashMap::from([("made".into(), "by a test".into())])).unwrap();
    assert_eq!(read(&path, &|_| true).unwrap(), arrays);
    let twice = [arrays[0].clone(), arrays[0].clone()];
    assert!(save(&path, &twice, HashMap::new()).unwrap_err().to_string().contains("two arrays are named a.weight"));
}

/// A file in the format of PyTorch before 1.6, with one storage of floats named `0`.
fn legacy(tensors: &[u8], floats: &[f32]) -> Vec<u8> {
    let mut out = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.\x80\x02M\xe9\x03.\x80\x02}.\x80\x02}".to_vec();
    out.extend(tensors);
    out.extend(b".\x80\x02]X\x01\x00\x00\x000a.");
    out.extend((floats.len() as u64).to_le_bytes());
    floats.iter().for_each(|v| out.extend(v.to_le_bytes()));
    out
}

/// A dictionary entry for a tensor named `name` in that storage, which has `stored` numbers.
fn entry(name: u8, stored: u8, first: u8, shape: [u8; 2], strides: [u8; 2]) -> Vec<u8> {
    let mut out = vec![b'X', 1, 0, 0, 0, name];
    out.extend(
        b"ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK",
    );
    out.push(stored);
    out.extend(b"NtQK");
    out.push(first);
    out.extend([b'K', shape[0], b'K', shape[1], 0x86, b'K', strides[0], b'K', strides[1], 0x86]);
    out.extend(b"\x89}tRs");
    out
}

#[test]
fn transposed_tensors_are_put_in_rows() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.pth");
    std::fs::write(&path, legacy(&entry(b'w', 6, 0, [2, 3], [1, 2]), &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0])).unwrap();
    assert_eq!(read(&path, &|_| true).unwrap(), [NamedArray::new("w", &[2, 3], vec![1.0, 3.0, 5.0, 2.0, 4.0, 6.0])]);
}

#[test]
fn later_protocols_are_read_too() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.pth");
    let old = legacy(&entry(b'w', 1, 0, [1, 1], [1, 1]), &[7.0]);
    let framed = [&b"\x80\x04\x95\x0d\0\0\0\0\0\0\0"[..], &old[2..]].concat();
    std::fs::write(&path, framed).unwrap();
    assert_eq!(read(&path, &|_| true).unwrap(), [NamedArray::new("w", &[1, 1], vec![7.0])]);
}

#[test]
fn hostile_files_get_one_line_and_no_memory() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.pth");
    let call =
        |module: &str| [b"X\x01\x00\x00\x00xc".to_vec(), module.as_bytes().to_vec(), b"X\x04\x00\x00\x00true\x85Rs".to_vec()].concat();
    let shared: Vec<u8> = (0..60).flat_map(|i| entry(b'0' + i, 200, 0, [200, 1], [1, 1])).collect();
    for (tensors, what) in [
        (call("os\nsystem\n"), "would run os.system"),
        (call("builtins\neval\n"), "would run builtins.eval"),
        (call("subprocess\nPopen\n"), "would run subprocess.Popen"),
        // A tensor of 65,025 numbers from a storage of one, and one that starts beyond its storage.
        (entry(b'w', 1, 0, [255, 255], [0, 0]), "more numbers than the file has bytes"),
        (entry(b'w', 1, 0, [2, 3], [1, 2]), "beyond its storage"),
        (entry(b'w', 1, 9, [1, 1], [1, 1]), "beyond its storage"),
        (entry(b'w', 200, 0, [1, 1], [1, 1]), "shorter than described"),
        ([entry(b'w', 200, 0, [200, 1], [1, 1]), shared].concat(), "more numbers than the file has bytes"),
    ] {
        std::fs::write(&path, legacy(&tensors, &[1.0])).unwrap();
        let e = read(&path, &|_| true).unwrap_err();
        let line = e.to_string();
        assert!(e.is_input() && line.contains(what) && line.lines().count() == 1, "{what}: {line}");
    }
    // A list that contains itself, and a storage that claims 2⁶³ numbers.
    let mut claims = legacy(&entry(b'w', 1, 0, [1, 1], [1, 1]), &[1.0]);
    let n = claims.len();
    claims[n - 12..n - 4].copy_from_slice(&(1u64 << 63).to_le_bytes());
    std::fs::write(&path, claims).unwrap();
    assert!(read(&path, &|_| true).unwrap_err().to_string().contains("larger than the file"));
}

#[test]
fn texts_beside_the_tensors_are_read_and_other_files_have_none() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.safetensors");
    let texts = HashMap::from([("model".to_string(), "db".to_string())]);
    save(&path, &[NamedArray::new("w", &[2], vec![1.0, 2.0])], texts.clone()).unwrap();
    assert_eq!(metadata(&path).unwrap(), texts);
    save(&path, &[NamedArray::new("w", &[1], vec![1.0])], HashMap::new()).unwrap();
    assert!(metadata(&path).unwrap().is_empty() && metadata(&sample("small.pth")).unwrap().is_empty());
    for bytes in [&b""[..], b"\xff\xff\xff\xff\xff\xff\xff\xff{}", b"\x02\0\0\0\0\0\0\0{]"] {
        std::fs::write(&path, bytes).unwrap();
        assert!(metadata(&path).unwrap().is_empty());
    }
    assert!(metadata(&dir.path().join("none")).is_err());
}
