//! Coverage-guided fuzzing of `osr_matrix`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("osr_matrix").run)(data));
