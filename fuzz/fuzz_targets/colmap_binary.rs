//! Coverage-guided fuzzing of `colmap_binary`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("colmap_binary").run)(data));
