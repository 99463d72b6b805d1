//! Processors of this machine: its CPU and its GPUs.

pub use crate::api::Api;
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

/// A GPU that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GpuInfo {
    pub api: Api,
    /// Name that the driver reports.
    pub name: String,
    /// Whether a driver on the CPU emulates it.
    pub software: bool,
}

/// GPUs that this build can use on this machine, one per API, best first; never fails.
pub fn gpus() -> Vec<GpuInfo> {
    #[cfg(feature = "gpu")]
    let found = |api| crate::gpu::Gpu::open(api).ok().map(|g| GpuInfo { api, name: g.name, software: g.software });
    #[cfg(not(feature = "gpu"))]
    let found = |_| None;
    Api::ALL.into_iter().filter(|a| a.is_built()).filter_map(found).collect()
}

/// Lets kernels without half precision be compiled where NVRTC is there but no CUDA toolkit, in whose place CubeCL
/// insists on some folder.
///
/// Must be called before the program starts a thread.
pub fn settle_cuda_path() {
    let usual = ["/usr/local/cuda", "/opt/cuda", "/usr/bin/nvcc"];
    if cfg!(all(feature = "cuda", target_os = "linux"))
        && std::env::var_os("CUDA_PATH").is_none()
        && !usual.iter().any(|p| std::path::Path::new(p).exists())
    {
        // SAFETY: no other thread reads the environment yet.
        unsafe { std::env::set_var("CUDA_PATH", std::env::temp_dir()) };
    }
}

/// Keeps Mesa's device-select layer, which asks the desktop for the preferred GPU, from complaining aloud where
/// there is no desktop; devices are chosen here anyway.
///
/// Must be called before the program starts a thread.
pub fn quiet_drivers() {
    let is_set = |name| std::env::var_os(name).is_some();
    if cfg!(feature = "gpu") && !is_set("XDG_RUNTIME_DIR") && !is_set("NODEVICE_SELECT") {
        // SAFETY: no other thread reads the environment yet.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}
