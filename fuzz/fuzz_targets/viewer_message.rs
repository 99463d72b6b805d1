//! Coverage-guided fuzzing of `viewer_message`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("viewer_message").run)(data));
