use super::*;
use diorama_testkit::assert_close;

#[test]
fn matches_the_reference() {
    let bytes: Vec<u8> = (0..=255).cycle().take(4000).collect();
    for n in [0, 1, 333] {
        let at: Vec<usize> = (0..n).map(|i| (i * 37 % 999) * 4).collect();
        let mut out = vec![9.0; n * 4];
        cpu::gather(&bytes, &at, &mut out);
        assert_close("rgba", &out, &reference::gather(&bytes, &at), 1e-6);
    }
}
