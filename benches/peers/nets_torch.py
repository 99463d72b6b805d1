"""Times the layers of `crates/kernels/examples/bench_conv.rs` in PyTorch, best of NCHW and channels_last.

    python benches/peers/nets_torch.py [--threads N] [NAME...]

Prints one line per layer: ms and GFLOP/s per core, forward and forward with backward.
"""

import argparse
import time

import torch
import torch.nn.functional as F

# name: (kind, batch, channels in, channels out, height = width, kernel, stride, padding, groups)
CONVS = {
    "conv3x3_64_128": ("conv", 1, 64, 64, 128, 3, 1, 1, 1),
    "conv3x3_64_128_b8": ("conv", 8, 64, 64, 128, 3, 1, 1, 1),
    "conv1x1_64_128_b8": ("conv", 8, 64, 64, 128, 1, 1, 0, 1),
    "conv1x1_256_40_b4": ("conv", 4, 256, 256, 40, 1, 1, 0, 1),
    "conv3x3s2_64_128_b8": ("conv", 8, 64, 64, 128, 3, 2, 1, 1),
    "conv7x7s2_3_320_b4": ("conv", 4, 3, 64, 320, 7, 2, 3, 1),
    "conv7x7_16_128_b8": ("conv", 8, 16, 16, 128, 7, 1, 3, 1),
    "dw3x3_64_128_b8": ("conv", 8, 64, 64, 128, 3, 1, 1, 64),
    "dw3x3s2_64_128_b8": ("conv", 8, 64, 64, 128, 3, 2, 1, 64),
    "tconv4x4s2_64_64_b8": ("transpose", 8, 64, 64, 64, 4, 2, 1, 1),
    "tconv2x2s2_128_32_b8": ("transpose", 8, 128, 64, 32, 2, 2, 0, 1),
    "resnet_64_80_b4": ("conv", 4, 64, 64, 80, 3, 1, 1, 1),
    "resnet_64_128_80s2_b4": ("conv", 4, 64, 128, 80, 3, 2, 1, 1),
    "resnet_128_40_b4": ("conv", 4, 128, 128, 40, 3, 1, 1, 1),
    "resnet_256_20_b4": ("conv", 4, 256, 256, 20, 3, 1, 1, 1),
    "resnet_512_10_b4": ("conv", 4, 512, 512, 10, 3, 1, 1, 1),
    "vgg_3_64_224": ("conv", 1, 3, 64, 224, 3, 1, 1, 1),
    "vgg_64_224": ("conv", 1, 64, 64, 224, 3, 1, 1, 1),
    "vgg_128_112": ("conv", 1, 128, 128, 112, 3, 1, 1, 1),
    "vgg_256_56": ("conv", 1, 256, 256, 56, 3, 1, 1, 1),
    "vgg_512_28": ("conv", 1, 512, 512, 28, 3, 1, 1, 1),
    "vgg_512_14": ("conv", 1, 512, 512, 14, 3, 1, 1, 1),
}

# name: (batch, m, k, n, b is transposed)
PRODUCTS = {
    "linear_384_65536": (1, 65536, 384, 384, False),
    "linear_768_3072_b4x50": (1, 200, 768, 3072, False),
    "vgg_fc_25088_4096": (1, 1, 25088, 4096, False),
    "attention_qk_12x50": (48, 50, 64, 50, True),
    "attention_pv_12x50": (48, 50, 50, 64, False),
    "attention_qk_12x577": (12, 577, 64, 577, True),
}


def seconds(work, least=0.4):
    work()
    begin = time.perf_counter()
    work()
    once = time.perf_counter() - begin
    times = []
    for _ in range(max(5, int(least / max(once, 1e-6)))):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def report(name, flops, forward, training, threads, note=""):
    f, t = flops / forward / threads / 1e9, 3 * flops / training / threads / 1e9
    print(f"{name:24} forward {forward * 1e3:9.3f} ms {f:7.1f}  training {training * 1e3:9.3f} ms {t:7.1f} GFLOP/s per core {note}", flush=True)


def conv(name, spec, threads):
    kind, batch, c_in, c_out, size, kernel, stride, padding, groups = spec
    best = {}
    for layout in (torch.contiguous_format, torch.channels_last):
        x = torch.randn(batch, c_in, size, size).to(memory_format=layout)
        shape = (c_out, c_in // groups, kernel, kernel) if kind == "conv" else (c_in, c_out // groups, kernel, kernel)
        w, b = torch.randn(shape).to(memory_format=layout), torch.randn(c_out)
        op = F.conv2d if kind == "conv" else F.conv_transpose2d
        run = lambda x, w, b: op(x, w, b, stride=stride, padding=padding, groups=groups)
        with torch.no_grad():
            y = run(x, w, b)
            forward = seconds(lambda: run(x, w, b))
        xg, wg, bg = (v.detach().clone(memory_format=torch.preserve_format).requires_grad_() for v in (x, w, b))
        d = torch.randn_like(y)
        training = seconds(lambda: torch.autograd.grad(run(xg, wg, bg), (xg, wg, bg), d))
        pixels = (y if kind == "conv" else x)[0, 0].numel()
        flops = 2 * batch * pixels * c_out * c_in // groups * kernel * kernel
        best[layout] = (forward, training)
    layouts = {torch.contiguous_format: "nchw", torch.channels_last: "nhwc"}
    f = min(best, key=lambda k: best[k][0])
    t = min(best, key=lambda k: best[k][1])
    report(name, flops, best[f][0], best[t][1], threads, f"({layouts[f]}, {layouts[t]})")


def product(name, spec, threads):
    batch, m, k, n, transposed = spec
    a = torch.randn(batch, m, k)
    b = torch.randn(batch, n, k).transpose(1, 2) if transposed else torch.randn(batch, k, n)
    with torch.no_grad():
        forward = seconds(lambda: torch.bmm(a, b))
    ag, bg = a.clone().requires_grad_(), b.detach().requires_grad_()
    d = torch.randn(batch, m, n)
    training = seconds(lambda: torch.autograd.grad(torch.bmm(ag, bg), (ag, bg), d))
    report(name, 2 * batch * m * k * n, forward, training, threads)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("names", nargs="*")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    for name, spec in CONVS.items():
        if not args.names or any(n in name for n in args.names):
            conv(name, spec, args.threads)
    for name, spec in PRODUCTS.items():
        if not args.names or any(n in name for n in args.names):
            product(name, spec, args.threads)


main()
