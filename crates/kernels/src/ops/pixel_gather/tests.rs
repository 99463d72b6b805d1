use super::*;
use diorama_testkit::assert_close;

#[test]
fn matches_the_reference() {
    for cases::Case { format, words, at } in cases::cases() {
        let mut out = vec![9.0; at.len() * 4];
        cpu::gather(format, &words, &at, &mut out);
        assert_close("rgba", &out, &reference::gather(format, &words, &at), 1e-6);
    }
}

#[test]
fn half_floats_of_any_size_are_read() {
    // All finite ones of both signs, subnormal ones among them.
    let sixteen = |i: u32| i.wrapping_mul(2477) & 0xfbff;
    let words: Vec<u32> = (0..4000).map(|i| sixteen(2 * i + 1) << 16 | sixteen(2 * i)).collect();
    let at: Vec<usize> = (0..333).map(|i| i * 37 % 1999).collect();
    let mut out = vec![9.0; at.len() * 4];
    cpu::gather(PixelFormat::Half, &words, &at, &mut out);
    assert_close("rgba", &out, &reference::gather(PixelFormat::Half, &words, &at), 1e-6);
}
