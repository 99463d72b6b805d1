//! Coverage-guided fuzzing of `text_labels`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("text_labels").run)(data));
