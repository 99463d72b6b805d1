//! Coverage-guided fuzzing of `run_config`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("run_config").run)(data));
