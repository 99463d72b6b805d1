//! Coverage-guided fuzzing of `http_request`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("http_request").run)(data));
