//! Coverage-guided fuzzing of `cut_photo`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("cut_photo").run)(data));
