//! Coverage-guided fuzzing of `checkpoint`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("checkpoint").run)(data));
