//! Coverage-guided fuzzing of `colmap_points`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("colmap_points").run)(data));
