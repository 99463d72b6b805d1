//! Coverage-guided fuzzing of `session_list`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("session_list").run)(data));
