"""Times the CPU ops of networks in PyTorch and in ours, in one call, and prints the ratios (above 1: ours is faster).

Usage: ops_torch.py [NAME], for names that contain NAME, after `cargo build --release -p diorama-kernels --example ops-speed`.
PyTorch allocates each output; the C library is set to keep freed memory, so that it is not requested from the system each time.
Backward is `autograd.grad` alone. Ours runs before and after; the faster of its medians counts, as does that of two rounds here.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

KEEP = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(1 << 40), "MALLOC_TOP_PAD_": str(1 << 26), "MALLOC_ARENA_MAX": "1"}
if any(os.environ.get(k) != v for k, v in KEEP.items()):
    os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **KEEP})

import torch
import torch.nn.functional as F

THREADS = int(os.environ.get("THREADS", "2"))
torch.set_num_threads(THREADS)
ONLY = sys.argv[1] if len(sys.argv) > 1 else ""
TIMES = {}


def median(name, call):
    if ONLY not in name:
        return
    call()
    begin, times = time.perf_counter(), []
    while len(times) < 5 or (time.perf_counter() - begin < 0.3 and len(times) < 200):
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1e3)
    middle = sorted(times)[len(times) // 2]
    TIMES[name] = min(middle, TIMES.get(name, middle))


def op(name, f, *inputs):
    """Forward without a graph; backward of a kept graph."""
    if ONLY not in name + ".forward" and ONLY not in name + ".backward":
        return
    with torch.no_grad():
        median(name + ".forward", lambda: f(*inputs))
    inputs = [i.requires_grad_() for i in inputs]
    out = f(*inputs)
    d = torch.rand_like(out)
    median(name + ".backward", lambda: torch.autograd.grad(out, inputs, d, retain_graph=True))


def norms():
    x, w, b = torch.rand(8, 64, 128, 128), torch.rand(64), torch.rand(64)
    mean, var = torch.zeros(64), torch.ones(64)
    op("batch_norm_relu", lambda x, w, b: F.relu_(F.batch_norm(x, mean, var, w, b, True)), x, w, b)
    op("batch_norm_silu", lambda x, w, b: F.silu(F.batch_norm(x, mean, var, w, b, True)), x, w, b)
    op("given_norm_relu", lambda x, w, b: F.relu_(F.batch_norm(x, mean, var, w, b, False)), x, w, b)
    op("group_norm", lambda x, w, b: F.group_norm(x, 8, w, b), x, w, b)
    op("layer_norm", lambda x, w, b: F.layer_norm(x, (384,), w, b), torch.rand(65536, 384), torch.rand(384), torch.rand(384))


def images():
    x = torch.rand(4, 128, 40, 40)
    op("bilinear_x2", lambda x: F.interpolate(x, scale_factor=2, mode="bilinear"), x)
    op("bilinear_corners_40_to_100", lambda x: F.interpolate(x, size=100, mode="bilinear", align_corners=True), torch.rand(4, 64, 40, 40))
    op("nearest_x2", lambda x: F.interpolate(x, scale_factor=2), x)
    op("bicubic_antialiased_512_to_224", lambda x: F.interpolate(x, size=224, mode="bicubic", antialias=True), torch.rand(4, 3, 512, 512))
    op("bicubic_antialiased_128_to_256", lambda x: F.interpolate(x, size=256, mode="bicubic", antialias=True), torch.rand(4, 3, 128, 128))
    x = torch.rand(4, 64, 160, 160)
    op("area_160_to_7", lambda x: F.adaptive_avg_pool2d(x, 7), x)
    taps = torch.tensor([0.125, 0.375, 0.375, 0.125])
    kernel = torch.outer(taps, taps).expand(64, 1, 4, 4).contiguous()
    op("blur_down", lambda x: F.conv2d(x, kernel, stride=2, padding=1, groups=64), torch.rand(4, 64, 128, 128))
    op("average_pool_2", lambda x: F.avg_pool2d(x, 2), x)
    op("pixel_shuffle", lambda x: F.pixel_shuffle(x, 2).contiguous(), torch.rand(4, 256, 40, 40))
    op("max_pool_3", lambda x: F.max_pool2d(x, 3, 2, 1), x)
    op("global_average", lambda x: F.adaptive_avg_pool2d(x, 1), x)
    grid = torch.rand(4, 128, 128, 2) * 2 - 1
    op("grid_sample", lambda x, g: F.grid_sample(x, g, align_corners=False), torch.rand(4, 32, 64, 64), grid)


def rows():
    x = torch.rand(8192, 1000) * 2 - 1
    op("softmax_1000", lambda x: x.softmax(-1), x)
    classes = torch.arange(8192) * 7 % 1000
    op("cross_entropy_1000", lambda x: F.cross_entropy(x, classes, label_smoothing=0.1), x)
    for name, f in {
        "relu": F.relu,
        "softplus": F.softplus,
        "sigmoid": torch.sigmoid,
        "tanh": torch.tanh,
        "silu": F.silu,
        "gelu": F.gelu,
        "gelu_tanh": lambda x: F.gelu(x, approximate="tanh"),
    }.items():
        op(name, f, x)
    median("dropout.forward", lambda: F.dropout(x, 0.1))
    indices = torch.arange(8192) * 7919 % 32000
    op("embedding", lambda t: F.embedding(indices, t), torch.rand(32000, 256))


def attentions():
    for batch, tokens in ((12, 50), (192, 50), (12, 197), (12, 1024)):
        q, k, v = (torch.rand(batch // 12, 12, tokens, 64) * 2 - 1 for _ in range(3))
        op(f"attention_{batch}x{tokens}", F.scaled_dot_product_attention, q, k, v)


def ours():
    program = Path(__file__).parents[2] / "target/release/examples/ops-speed"
    text = subprocess.run([program, ONLY], check=True, capture_output=True, text=True, env={**os.environ, "RAYON_NUM_THREADS": str(THREADS)})
    return {name: float(ms) for name, ms in (line.split() for line in text.stdout.splitlines())}


if __name__ == "__main__":
    first = ours()
    for _ in range(2):
        for part in (norms, images, rows, attentions):
            part()
    second = ours()
    print(f"torch {torch.__version__}, {THREADS} threads")
    print(f"{'op':<42}{'torch ms':>10}{'ours ms':>10}{'ratio':>8}")
    for name, torch_ms in TIMES.items():
        if name in first:
            ms = min(first[name], second[name])
            print(f"{name:<42}{torch_ms:>10.3f}{ms:>10.3f}{torch_ms / ms:>8.2f}")
