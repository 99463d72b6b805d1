//! Coverage-guided fuzzing of `gltf`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| (diorama_fuzz::parser("gltf").run)(data));
