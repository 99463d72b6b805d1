//! Coverage-guided fuzzing of `poses_bounds_npy`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("poses_bounds_npy").run)(data));
