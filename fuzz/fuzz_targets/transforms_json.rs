//! Coverage-guided fuzzing of `transforms_json`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("transforms_json").run)(data));
