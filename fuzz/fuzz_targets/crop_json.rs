//! Coverage-guided fuzzing of `crop_json`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("crop_json").run)(data));
