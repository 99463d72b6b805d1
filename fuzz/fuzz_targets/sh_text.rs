//! Coverage-guided fuzzing of `sh_text`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("sh_text").run)(data));
