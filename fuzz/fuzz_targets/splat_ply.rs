//! Coverage-guided fuzzing of `zip`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("splat_ply").run)(data));
