//! Coverage-guided fuzzing of `photo`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("photo").run)(data));
