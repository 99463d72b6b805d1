//! Comparisons of every op on a device with its reference.

use crate::{PROGRAMS, cargo, step};
use std::process::{Command, Stdio};

/// Compares every op on each device, of several separated by commas, with its reference: in the default build by `diorama bench check`, which
/// compares training as well. For other devices only the crates with kernels are built, with burn's GPU backend; ops in burn's graph are
/// compared too.
pub fn check(devices: &str) -> bool {
    let devices: Vec<&str> = devices.split(',').collect();
    // The default build includes Vulkan (Metal on macOS).
    let (native, others): (Vec<&str>, Vec<&str>) = devices.into_iter().partition(|d| ["vulkan", "metal"].contains(d));
    (native.is_empty() || check_native(&native)) & (others.is_empty() || check_others(&others))
}

/// Devices of the default build.
fn check_native(devices: &[&str]) -> bool {
    if !step("build", cargo(&PROGRAMS)) {
        return false;
    }
    // Training is compared on a real capture if there is one.
    let fox = std::env::var("DIORAMA_TEST_DATA").map(|d| format!("{d}/fox")).unwrap_or_default();
    let data = if std::path::Path::new(&fox).is_dir() { vec!["--data", &fox] } else { Vec::new() };
    let check = |device: &&str| {
        let args = [&["bench", "check", "--device", device][..], &data].concat();
        step(device, on_device(device, "target/release/diorama", &args))
    };
    devices.iter().map(check).fold(true, |all, ok| all & ok)
}

/// Devices that need builds of their own.
fn check_others(devices: &[&str]) -> bool {
    let features = format!("gpu,{}", devices.join(","));
    let examples = ["--package", "diorama-engine", "--example", "ops-check", "--package", "diorama-nets", "--example", "graph-check"];
    let args = [&["build", "--release"][..], &examples, &["--features", &features]].concat();
    println!("\n$ cargo {}", args.join(" "));
    let built = Command::new("cargo").args(args).status().is_ok_and(|s| s.success());
    if !step("build", built) {
        return false;
    }
    let check = |device: &&str| {
        let ops = step(&format!("{device}, ops and views"), on_device(device, "target/release/examples/ops-check", &[device]));
        let graph = step(&format!("{device}, burn's graph"), on_device(device, "target/release/examples/graph-check", &[device]));
        ops & graph
    };
    devices.iter().map(check).fold(true, |all, ok| all & ok)
}

/// Runs a check, with CUDA emulated on the CPU if there is no such device.
fn on_device(device: &str, program: &str, args: &[&str]) -> bool {
    println!("\n$ {program} {}", args.join(" "));
    let mut check = Command::new(program);
    check.args(args);
    let ready = device != "cuda" || has_nvidia() || emulate_cuda(&mut check);
    ready && check.status().is_ok_and(|s| s.success())
}

fn has_nvidia() -> bool {
    Command::new("nvidia-smi").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
}

/// Sets a command up to use the CPU emulation of CUDA's driver and compiler; returns whether they could be built.
fn emulate_cuda(command: &mut Command) -> bool {
    let (source, to) = (std::path::absolute("stubs/cuda-on-cpu"), std::path::absolute("target/cuda-on-cpu"));
    let (Ok(source), Ok(to)) = (source, to) else { return false };
    println!("no NVIDIA driver found: CUDA is emulated on the CPU");
    // Kernels cached by an earlier build of the emulation must not be used.
    let _ = std::fs::remove_dir_all(&to);
    let library = to.join("libcuda.so");
    command.env("CUDA_PATH", &source).env("LD_LIBRARY_PATH", &to);
    command.env("CUDA_ON_CPU_CACHE", to.join("kernels")).env("XDG_CACHE_HOME", to.join("cache"));
    let mut compile = Command::new("g++");
    compile.args(["-O2", "-U_FORTIFY_SOURCE", "-shared", "-fPIC", "-pthread"]).arg(source.join("driver.cpp"));
    compile.arg("-o").arg(&library).arg("-ldl");
    std::fs::create_dir_all(&to).is_ok()
        && compile.status().is_ok_and(|s| s.success())
        && std::fs::copy(&library, to.join("libnvrtc.so")).is_ok()
}
