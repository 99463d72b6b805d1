use super::*;
use diorama_testkit::assert_close;

#[test]
fn matches_the_reference() {
    for format in [PixelFormat::Unorm8, PixelFormat::Unorm16, PixelFormat::Half] {
        // Half floats: all finite ones of both signs, subnormal ones among them.
        let sixteen = |i: u32| i.wrapping_mul(2477) & 0xffff & if format == PixelFormat::Half { 0xfbff } else { 0xffff };
        let words: Vec<u32> = (0..4000).map(|i| sixteen(2 * i + 1) << 16 | sixteen(2 * i)).collect();
        for n in [0, 1, 333] {
            let at: Vec<usize> = (0..n).map(|i| i * 37 % 1999).collect();
            let mut out = vec![9.0; n * 4];
            cpu::gather(format, &words, &at, &mut out);
            assert_close("rgba", &out, &reference::gather(format, &words, &at), 1e-6);
        }
    }
}
