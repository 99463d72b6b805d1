//! Coverage-guided fuzzing of `environment`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("environment").run)(data));
