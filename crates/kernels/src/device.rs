//! What this machine can compute on.

use crate::simd::{self, Level};

/// The processor as the kernels see it.
#[derive(Clone, Debug)]
pub struct Cpu {
    pub cores: usize,
    pub threads: usize,
    pub level: Level,
    pub features: Vec<&'static str>,
}

/// Probes the CPU; never fails.
pub fn cpu() -> Cpu {
    let mut features = Vec::new();
    #[cfg(target_arch = "x86_64")]
    {
        macro_rules! probe {
            ($($f:tt),*) => { $(if std::arch::is_x86_feature_detected!($f) { features.push($f); })* };
        }
        probe!("sse4.1", "avx", "avx2", "fma", "f16c", "avx512f", "avx512dq", "avx512bw", "avx512vl", "avx512bf16");
    }
    #[cfg(target_arch = "aarch64")]
    features.push("neon");
    Cpu {
        cores: std::thread::available_parallelism().map_or(1, |n| n.get()),
        threads: rayon::current_num_threads(),
        level: simd::level(),
        features,
    }
}
