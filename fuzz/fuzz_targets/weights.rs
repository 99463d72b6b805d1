//! Coverage-guided fuzzing of `weights`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("weights").run)(data));
