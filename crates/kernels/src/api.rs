//! Ways to reach a GPU.

/// How a GPU is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Api {
    Cuda,
    Vulkan,
    Metal,
    WebGpu,
}

impl Api {
    /// Best first.
    pub const ALL: [Api; 4] = [Api::Cuda, Api::Vulkan, Api::Metal, Api::WebGpu];

    /// The name that `--device` takes, which is also the feature's.
    pub fn name(self) -> &'static str {
        match self {
            Api::Cuda => "cuda",
            Api::Vulkan => "vulkan",
            Api::Metal => "metal",
            Api::WebGpu => "webgpu",
        }
    }

    /// Whether this build can reach it.
    pub fn is_built(self) -> bool {
        match self {
            Api::Cuda => cfg!(feature = "cuda"),
            Api::Vulkan => cfg!(any(feature = "vulkan", all(feature = "native", not(target_os = "macos")))),
            Api::Metal => cfg!(any(feature = "metal", all(feature = "native", target_os = "macos"))),
            Api::WebGpu => cfg!(feature = "webgpu"),
        }
    }

    /// Message for a build that cannot reach it.
    pub fn not_built(self) -> String {
        let name = self.name();
        match self {
            Api::Metal if !cfg!(target_os = "macos") => return "device metal: only macOS has it; use --device auto".into(),
            Api::Vulkan if cfg!(target_os = "macos") => return "device vulkan: macOS has metal instead; use --device metal".into(),
            _ => {}
        }
        format!("device {name}: this build cannot reach it; build it with `cargo build --release --features {name}`, or use --device cpu")
    }
}

impl std::str::FromStr for Api {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        Api::ALL.into_iter().find(|a| a.name() == s).ok_or_else(|| format!("device {s:?}: expected cpu, cuda, vulkan, metal or webgpu"))
    }
}
