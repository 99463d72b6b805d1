//! GPUs through CubeCL: one kernel source for Vulkan, Metal, WebGPU and CUDA. Ops keep their kernels in
//! `ops/<op>/gpu.rs`; data stays in [`Buffer`]s on the device until it is read.

mod atomics;
mod buffer;
pub(crate) mod launch;
pub(crate) mod random;
pub(crate) mod table;
pub(crate) mod vector;

use crate::api::Api;
pub use atomics::{Accumulate, Native, Pair, Swap};
pub use buffer::{Buffer, Rows};
use cubecl::client::Client;
use cubecl::device::{WgpuBackend, WgpuDevice, WgpuDeviceKind};
use cubecl::ir::features::AtomicUsage;
use cubecl::prelude::*;
pub(crate) use launch::launch;

/// Units per cube of the kernels that treat one element per unit.
pub const CUBE: u32 = 256;
/// Device name of `stubs/cuda-on-cpu`.
const CUDA_ON_CPU: &str = "CPU playing CUDA";

/// Why a device cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    #[error("{}", .0.not_built())]
    NotBuilt(Api),
    #[error("device {0}: none found on this machine; check its driver, or use --device cpu")]
    NoDevice(&'static str),
    #[error("device {0}: could not be opened: {1}; use --device cpu")]
    Open(&'static str, String),
    #[error("device {0}: {1}")]
    Lost(String, String),
    /// The device has no room for what is asked of it.
    #[error("device {0}: out of memory: {1}")]
    Memory(String, String),
}

/// An open device.
#[derive(Clone)]
pub struct Gpu {
    pub api: Api,
    /// Name that the driver reports.
    pub name: String,
    /// Whether a driver on the CPU emulates the device.
    pub software: bool,
    device: cubecl::Device,
    pub(crate) client: Client,
    /// Whether the device adds f32 atomically; without it kernels use exchanges ([`Swap`]).
    pub(crate) native_atomics: bool,
    /// Whether the device adds pairs of f32 atomically.
    pair_atomics: bool,
    /// Whether kernels use memory shared by a cube. Mesa's software Vulkan before 23 crashes on it as SPIR-V
    /// declares it, and gains nothing from it.
    pub(crate) shared: bool,
}

impl Gpu {
    /// Opens the best device of an API: discrete before integrated before software.
    ///
    /// # Errors
    /// When the build lacks the API, the machine has no such device, or it cannot be opened.
    pub fn open(api: Api) -> Result<Gpu, GpuError> {
        Gpu::open_kind(api, true)
    }

    /// Opens the best device of an API that is hardware.
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub fn open_hardware(api: Api) -> Result<Gpu, GpuError> {
        Gpu::open_kind(api, false)
    }

    fn open_kind(api: Api, or_software: bool) -> Result<Gpu, GpuError> {
        if !api.is_built() {
            return Err(GpuError::NotBuilt(api));
        }
        #[cfg(feature = "cuda")]
        keep_compiled();
        let (device, software) = find(api).filter(|(_, software)| or_software || !software).ok_or(GpuError::NoDevice(api.name()))?;
        let client = catch_quietly(|| device.client()).map_err(|e| GpuError::Open(api.name(), e))?;
        Ok(Gpu::with(api, device, software, client))
    }

    fn with(api: Api, device: cubecl::Device, software: bool, client: Client) -> Gpu {
        let adds = |width: usize| {
            let cell = Type::atomic(f32::elem_type_native().with_vector_size(width));
            client.properties().atomic_type_usage(cell).contains(AtomicUsage::Add)
        };
        let native_atomics = adds(1);
        let name = client.properties().identity.name.clone();
        // The emulation has them without the other properties of compute capability 9.0, which CubeCL concludes them from.
        let pair_atomics = adds(2) || name == CUDA_ON_CPU;
        let software = software || name == CUDA_ON_CPU;
        // A build with Vulkan speaks SPIR-V to it under any name.
        let spirv = api == Api::Vulkan || (api == Api::WebGpu && Api::Vulkan.is_built());
        Gpu { shared: !(software && spirv), api, name, software, device, client, native_atomics, pair_atomics }
    }

    /// A device that another library has opened.
    ///
    /// # Panics
    /// When ops cannot run on such a device.
    pub fn of(device: cubecl::Device, client: Client) -> Gpu {
        let (api, software) = match &device {
            cubecl::Device::Cuda(_) => (Api::Cuda, false),
            cubecl::Device::Wgpu(d) => {
                let api = match d.backend {
                    WgpuBackend::Vulkan => Api::Vulkan,
                    WgpuBackend::Metal => Api::Metal,
                    _ => Api::WebGpu,
                };
                (api, matches!(d.kind, WgpuDeviceKind::Cpu))
            }
            other => panic!("ops run on CUDA, Vulkan, Metal and WebGPU, not on {other:?}"),
        };
        Gpu::with(api, device, software, client)
    }

    /// The device as CubeCL names it, for another library that shares it.
    pub fn device(&self) -> &cubecl::Device {
        &self.device
    }

    /// Whether kernels may use memory shared by a cube.
    pub fn shares_memory(&self) -> bool {
        self.shared
    }

    /// The same device adding without native f32 atomics.
    pub fn without_native_atomics(&self) -> Gpu {
        Gpu { native_atomics: false, pair_atomics: false, ..self.clone() }
    }

    /// The same device adding pairs of f32 number by number.
    pub fn without_pair_atomics(&self) -> Gpu {
        Gpu { pair_atomics: false, ..self.clone() }
    }

    /// Whether kernels add pairs of f32 at once.
    pub fn has_pair_atomics(&self) -> bool {
        self.pair_atomics
    }

    pub fn has_native_atomics(&self) -> bool {
        self.native_atomics
    }

    /// Bytes of the largest piece of memory that can be had.
    pub fn largest_buffer(&self) -> u64 {
        self.client.properties().memory.max_page_size
    }

    /// Gives back memory that is no longer used.
    pub fn release(&self) {
        // A device that fails here also fails at the next read, which reports it.
        let _ = self.client.memory_cleanup();
    }

    /// Uninitialized memory for `len` numbers.
    pub fn empty<T>(&self, len: usize) -> Buffer<T> {
        Buffer::of(self.client.empty((len * size_of::<T>()).next_multiple_of(4).max(4)), len)
    }

    pub fn zeros<T>(&self, len: usize) -> Buffer<T> {
        let out = self.empty(len);
        let words: Buffer<u32> = out.cast();
        launch!(self, clear, words.len(), [words => words.len()], words.len() as u32);
        out
    }

    /// Copies as many numbers as both buffers hold.
    pub fn copy<T>(&self, from: &Buffer<T>, to: &Buffer<T>) {
        let (from, to): (Buffer<u32>, Buffer<u32>) = (from.cast(), to.cast());
        let n = from.len().min(to.len());
        launch!(self, duplicate, n, [from => n, to => n], n as u32);
    }

    /// Marks that are set in either buffer.
    pub fn either(&self, a: &Buffer<u32>, b: &Buffer<u32>) -> Buffer<u32> {
        let n = a.len().min(b.len());
        let out = self.empty(n);
        launch!(self, mark_either, n, [a => n, b => n, out => n], n as u32);
        out
    }

    pub fn upload<T: CubeElement>(&self, data: &[T]) -> Buffer<T> {
        let bytes = if data.is_empty() { &[0; 4] } else { T::as_bytes(data) };
        Buffer::of(self.client.create_from_slice(bytes), data.len())
    }

    /// [`Gpu::upload`], which fills the buffer on the device if all numbers are 0.
    pub fn upload_or_zeros(&self, data: &[f32]) -> Buffer {
        if data.iter().all(|v| v.to_bits() == 0) { self.zeros(data.len()) } else { self.upload(data) }
    }

    /// Waits for the device and downloads a buffer.
    ///
    /// # Errors
    /// When the device was lost or ran out of memory.
    pub fn read<T: CubeElement>(&self, buffer: &Buffer<T>) -> Result<Vec<T>, GpuError> {
        let bytes = self.client.read_one(buffer.memory()).map_err(|e| self.lost(&e))?;
        Ok(T::from_bytes(&bytes)[..buffer.len()].to_vec())
    }

    /// Waits for the device once and downloads several buffers.
    ///
    /// # Errors
    /// As [`Gpu::read`].
    pub fn read_together<const N: usize>(&self, buffers: [&Buffer; N]) -> Result<[Vec<f32>; N], GpuError> {
        let memory = buffers.iter().map(|b| b.memory()).collect();
        let bytes = self.client.read(memory).map_err(|e| self.lost(&e))?;
        Ok(std::array::from_fn(|i| f32::from_bytes(&bytes[i])[..buffers[i].len()].to_vec()))
    }

    /// Waits until all work is done.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn sync(&self) -> Result<(), GpuError> {
        cubecl::future::block_on(self.client.sync()).map_err(|e| self.lost(&e))
    }

    fn lost(&self, e: &dyn std::fmt::Debug) -> GpuError {
        let text = format!("{e:?}");
        let (name, cause) = (self.name.clone(), last_cause(&text));
        if is_out_of_memory(&text) { GpuError::Memory(name, cause) } else { GpuError::Lost(name, cause) }
    }
}

/// Lets CubeCL keep compiled kernels in the user's cache folder for the next start, unless the program has configured it already.
#[cfg(feature = "cuda")]
fn keep_compiled() {
    use cubecl::config::cache::CacheConfig;
    use cubecl::config::{CubeClRuntimeConfig, RuntimeConfig};
    let mut c = CubeClRuntimeConfig::default();
    c.compilation.cache = true;
    c.environment.path = CacheConfig::Global;
    CubeClRuntimeConfig::try_set(c);
}

/// Whether the text of a failure, CubeCL's or a driver's, means that memory was short. CubeCL allocates late; about an allocation that
/// failed it only says that its memory was never initialized.
fn is_out_of_memory(text: &str) -> bool {
    let text = text.to_lowercase().replace([' ', '_'], "");
    ["outofmemory", "neverinitialized", "can'tallocate", "buffertoobig", "outofdevicememory", "outofhostmemory"]
        .iter()
        .any(|t| text.contains(t))
}

/// Last cause of a failure in one line, without kernel sources and backtraces.
fn last_cause(text: &str) -> String {
    const MOST: usize = 240;
    let end = [text.find("[Source]"), text.find("Backtrace"), text.find("No backtrace")].into_iter().flatten().min().unwrap_or(text.len());
    let cause = text[..end].rsplit("Caused by:").find(|c| !c.trim().is_empty()).unwrap_or("the device failed");
    let line = cause.split_whitespace().collect::<Vec<_>>().join(" ");
    match line.char_indices().nth(MOST) {
        Some((at, _)) => format!("{}…", &line[..at]),
        None => line,
    }
}

/// Whether the headers that CUDA kernels with half precision include are installed.
pub(crate) fn has_cuda_headers() -> bool {
    let own = std::env::var_os("CUDA_PATH").map(std::path::PathBuf::from);
    let usual = ["/usr/local/cuda", "/opt/cuda", "C:/Program Files/NVIDIA GPU Computing Toolkit/CUDA"].map(std::path::PathBuf::from);
    own.map_or(usual.to_vec(), |p| vec![p]).iter().any(|p| p.join("include/mma.h").exists())
}

fn find(api: Api) -> Option<(cubecl::Device, bool)> {
    let on = |kind, backend| WgpuDevice::new(kind).on(backend);
    let backend = match api {
        Api::Cuda => return catch_quietly(|| cubecl::Device::cuda(0)).ok()?.ok().map(|d| (d, false)),
        Api::Vulkan => WgpuBackend::Vulkan,
        Api::Metal => WgpuBackend::Metal,
        Api::WebGpu => WgpuBackend::Auto,
    };
    let kinds = [
        WgpuDeviceKind::DiscreteGpu(0),
        WgpuDeviceKind::IntegratedGpu(0),
        WgpuDeviceKind::VirtualGpu(0),
        WgpuDeviceKind::Other(0),
        WgpuDeviceKind::Cpu,
    ];
    kinds.into_iter().find_map(|kind| {
        let software = matches!(kind, WgpuDeviceKind::Cpu);
        let device = cubecl::Device::Wgpu(on(kind, backend));
        let found = catch_quietly(|| !cubecl::Device::enumerate(device.to_id()).is_empty()).unwrap_or(false);
        found.then_some((device, software))
    })
}

/// Runs `work`, which may panic without a driver, and keeps the panic's message off the terminal.
fn catch_quietly<T>(f: impl FnOnce() -> T) -> Result<T, String> {
    static ONE: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let _one = ONE.lock();
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(f));
    std::panic::set_hook(hook);
    result.map_err(|e| {
        let text = e.downcast_ref::<String>().cloned().or_else(|| e.downcast_ref::<&str>().map(|s| s.to_string()));
        text.unwrap_or_default().lines().next().unwrap_or("the driver failed").to_string()
    })
}

#[cube(launch_unchecked)]
fn clear(out: &mut [u32], n: u32) {
    if ABSOLUTE_POS < n as usize {
        out[ABSOLUTE_POS] = 0u32;
    }
}

#[cube(launch_unchecked)]
fn duplicate(from: &[u32], to: &mut [u32], n: u32) {
    if ABSOLUTE_POS < n as usize {
        to[ABSOLUTE_POS] = from[ABSOLUTE_POS];
    }
}

#[cube(launch_unchecked)]
fn mark_either(a: &[u32], b: &[u32], out: &mut [u32], n: u32) {
    if ABSOLUTE_POS < n as usize {
        out[ABSOLUTE_POS] = a[ABSOLUTE_POS] | b[ABSOLUTE_POS];
    }
}

#[cfg(test)]
mod tests {
    use super::{is_out_of_memory, last_cause};

    #[test]
    fn a_full_device_is_told_apart_from_a_lost_one() {
        for full in [
            "Io(OutOfMemory { size: 9 })",
            "couldn't find resource: Memory location was never initialized",
            "BufferTooBig { size: 9 }",
            "VK_ERROR_OUT_OF_DEVICE_MEMORY",
            "CUDA: out of memory",
        ] {
            assert!(is_out_of_memory(full), "{full}");
        }
        assert!(!is_out_of_memory("DeviceLost: the memory of the device was reset"));
    }

    #[test]
    fn failures_are_told_in_one_line() {
        let long = "Several failures\nCaused by:\n  A launch error\nCaused by:\n  out of\n    memory\n[Source]\nfloat x;\nBacktrace: none";
        assert_eq!(last_cause(long), "out of memory");
        assert_eq!(last_cause("can't allocate buffer of size: 9\nNo backtrace available"), "can't allocate buffer of size: 9");
        assert_eq!(last_cause(""), "the device failed");
        assert_eq!(last_cause(&"é".repeat(500)).chars().count(), 241);
    }
}
