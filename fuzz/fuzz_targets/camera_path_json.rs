//! Coverage-guided fuzzing of `camera_path_json`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("camera_path_json").run)(data));
