"""Writes crates/kernels/tests/data/ops_torch.bin: small inputs, outputs and gradients of PyTorch's own ops.

Usage: ops_reference.py [FILE]. The file is a list of (u32 length, name, u32 count, count f32), little-endian.
`crates/kernels/src/ops/torch_cases.rs` compares them with ours; the names are the same there.
"""

import struct
import sys
from pathlib import Path

import torch
import torch.nn.functional as F

torch.manual_seed(7)
CASES = {}


def put(name, *tensors):
    for suffix, t in tensors:
        CASES[f"{name}.{suffix}"] = t.detach().float().flatten().tolist()


def op(name, f, *inputs, names="xyz"):
    """Stores f(*inputs), a random gradient of it, and the gradients of all inputs."""
    inputs = [i.clone().requires_grad_() for i in inputs]
    out = f(*inputs)
    d = torch.randn_like(out)
    put(name, ("out", out), ("d", d))
    for n, i, g in zip(names, inputs, torch.autograd.grad(out, inputs, d)):
        put(name, (n, i), ("d" + n, g))


def resample():
    ways = {
        "nearest": dict(mode="nearest"),
        "bilinear": dict(mode="bilinear", align_corners=False),
        "corners": dict(mode="bilinear", align_corners=True),
        "bilinear_antialiased": dict(mode="bilinear", antialias=True),
        "bicubic_antialiased": dict(mode="bicubic", antialias=True),
        "area": dict(mode="area"),
    }
    for i, (size, to) in enumerate([((3, 4), (6, 8)), ((9, 7), (4, 3)), ((5, 11), (4, 13)), ((1, 29), (1, 43))]):
        for way, options in ways.items():
            op(f"resample.{way}.{i}", lambda x: F.interpolate(x, size=to, **options), torch.randn(1, 1, *size))
    op("pixel_shuffle", lambda x: F.pixel_shuffle(x, 2), torch.randn(1, 8, 3, 2))
    taps = torch.tensor([0.1, 0.2, 0.3, 0.5])
    kernel = torch.outer(taps, taps).flip(0, 1)[None, None]
    op("blur.down", lambda x: F.conv2d(F.pad(x, (1, 2, 1, 2)), kernel, stride=2), torch.randn(1, 1, 5, 6))

    def up(x):
        spread = torch.zeros(1, 1, 2 * x.shape[2], 2 * x.shape[3])
        spread[:, :, ::2, ::2] = x
        return F.conv2d(F.pad(spread, (2, 1, 2, 1)), kernel)

    op("blur.up", up, torch.randn(1, 1, 4, 3))


def norm():
    x, w, b = torch.randn(3, 4, 2, 3) + 1, torch.randn(4), torch.randn(4)
    mean, var = torch.randn(4), torch.rand(4) + 0.5
    put("norm.batch", ("before_mean", mean), ("before_variance", var))
    put("norm.given", ("mean", mean), ("variance", var))
    op("norm.given", lambda x, w, b: F.relu(F.batch_norm(x, mean, var, w, b, False)), x, w, b, names="xwb")
    op("norm.batch", lambda x, w, b: F.leaky_relu(F.batch_norm(x, mean, var, w, b, True, 0.1), 0.2), x, w, b, names="xwb")
    put("norm.batch", ("after_mean", mean), ("after_variance", var))
    op("norm.group", lambda x, w, b: F.silu(F.group_norm(x, 2, w, b)), x, w, b, names="xwb")
    op("norm.instance", lambda x: F.instance_norm(x), x)
    w, b = torch.randn(6), torch.randn(6)
    op("norm.layer", lambda x, w, b: F.gelu(F.layer_norm(x, (6,), w, b)), torch.randn(4, 6), w, b, names="xwb")


def pool():
    for i, (k, s, p, ceil, size) in enumerate([(3, 2, 1, False, (6, 7)), (2, 2, 0, True, (5, 5)), (3, 2, 1, True, (5, 6)), (2, 3, 1, True, (4, 7))]):
        x = torch.randn(1, 1, *size)
        op(f"pool.max.{i}", lambda x: F.max_pool2d(x, k, s, p, ceil_mode=ceil), x)
        put(f"pool.max.{i}", ("indices", F.max_pool2d(x, k, s, p, ceil_mode=ceil, return_indices=True)[1]))
        for count in (False, True):
            op(f"pool.average.{i}.{int(count)}", lambda x: F.avg_pool2d(x, k, s, p, ceil_mode=ceil, count_include_pad=count), x)


def grid_sample():
    x, grid = torch.randn(1, 2, 3, 4), torch.rand(1, 2, 4, 2) * 2.6 - 1.3
    for mode in ("bilinear", "nearest"):
        for outside in ("zeros", "border"):
            for corners in (False, True):
                name = f"grid_sample.{mode}.{outside}.{int(corners)}"
                op(name, lambda x, g: F.grid_sample(x, g, mode, outside, corners), x, grid, names="xg")


def rows():
    x = torch.randn(6, 5) * 3
    classes = torch.tensor([0, 4, -100, 2, 2, -100])
    put("cross_entropy", ("classes", classes))
    op("cross_entropy", lambda x: F.cross_entropy(x, classes, label_smoothing=0.1), x)
    for name, f in {
        "leaky_relu": lambda x: F.leaky_relu(x, 0.2),
        "softplus": F.softplus,
        "silu": F.silu,
        "gelu": F.gelu,
        "gelu_tanh": lambda x: F.gelu(x, approximate="tanh"),
    }.items():
        op(f"activation.{name}", f, x)
    q, k, v = torch.randn(2, 3, 4), torch.randn(2, 3, 4), torch.randn(2, 3, 4)
    for causal in (False, True):
        f = lambda q, k, v: F.scaled_dot_product_attention(q, k, v, is_causal=causal)
        op(f"attention.{int(causal)}", f, q, k, v, names="qkv")


if __name__ == "__main__":
    for part in (resample, norm, pool, grid_sample, rows):
        part()
    default = Path(__file__).parents[2] / "crates/kernels/tests/data/ops_torch.bin"
    with open(sys.argv[1] if len(sys.argv) > 1 else default, "wb") as f:
        for name, values in CASES.items():
            f.write(struct.pack("<I", len(name)) + name.encode() + struct.pack(f"<I{len(values)}f", len(values), *values))
