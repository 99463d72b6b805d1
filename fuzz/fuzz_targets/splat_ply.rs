//! Coverage-guided fuzzing of `splat_ply`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("splat_ply").run)(data));
