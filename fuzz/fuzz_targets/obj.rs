//! Coverage-guided fuzzing of `obj`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("obj").run)(data));
