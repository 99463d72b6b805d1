//! Coverage-guided fuzzing of `jpeg_metadata`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("jpeg_metadata").run)(data));
