"""Times the layers and networks of `diorama bench nets` in PyTorch and ours in one call, and prints the ratios.

    cargo build --release
    python benches/peers/nets_torch.py target/release/diorama [--threads N] [--rounds N] [NAME...]

Ours and PyTorch's alternate. Each network runs in its own process, so that its peak memory can be measured. Medians of the rounds
are compared. PyTorch's figure is the better of its two layouts.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time

# (name, batch): kind, channels in, channels out, height = width, kernel, stride, padding, groups
LAYERS = {
    ("conv3x3_64_128", 1): ("conv", 64, 64, 128, 3, 1, 1, 1),
    ("conv3x3_64_128", 8): ("conv", 64, 64, 128, 3, 1, 1, 1),
    ("conv1x1_64_128", 8): ("conv", 64, 64, 128, 1, 1, 0, 1),
    ("conv1x1_256_40", 4): ("conv", 256, 256, 40, 1, 1, 0, 1),
    ("conv3x3s2_64_128", 8): ("conv", 64, 64, 128, 3, 2, 1, 1),
    ("conv7x7_16_128", 8): ("conv", 16, 16, 128, 7, 1, 3, 1),
    ("conv7x7s2_3_320", 4): ("conv", 3, 64, 320, 7, 2, 3, 1),
    ("dw3x3_64_128", 8): ("conv", 64, 64, 128, 3, 1, 1, 64),
    ("dw3x3s2_64_128", 8): ("conv", 64, 64, 128, 3, 2, 1, 64),
    ("tconv4x4s2_64_64", 8): ("transpose", 64, 64, 64, 4, 2, 1, 1),
    ("tconv2x2s2_128_32", 8): ("transpose", 128, 64, 32, 2, 2, 0, 1),
    ("resnet_64_80", 4): ("conv", 64, 64, 80, 3, 1, 1, 1),
    ("resnet_64_80s2", 4): ("conv", 64, 128, 80, 3, 2, 1, 1),
    ("resnet_128_40", 4): ("conv", 128, 128, 40, 3, 1, 1, 1),
    ("resnet_256_20", 4): ("conv", 256, 256, 20, 3, 1, 1, 1),
    ("resnet_512_10", 4): ("conv", 512, 512, 10, 3, 1, 1, 1),
    ("vgg_3_224", 1): ("conv", 3, 64, 224, 3, 1, 1, 1),
    ("vgg_64_224", 1): ("conv", 64, 64, 224, 3, 1, 1, 1),
    ("vgg_128_112", 1): ("conv", 128, 128, 112, 3, 1, 1, 1),
    ("vgg_256_56", 1): ("conv", 256, 256, 56, 3, 1, 1, 1),
    ("vgg_512_28", 1): ("conv", 512, 512, 28, 3, 1, 1, 1),
    ("vgg_512_14", 1): ("conv", 512, 512, 14, 3, 1, 1, 1),
    ("linear_384_384", 65536): ("linear", 384, 384, 1, 1, 1, 0, 1),
    ("linear_768_3072", 50): ("linear", 768, 3072, 1, 1, 1, 0, 1),
    ("linear_3072_768", 50): ("linear", 3072, 768, 1, 1, 1, 0, 1),
}


def median_ms(run, seconds, repeats=5):
    run()
    begin, times = time.perf_counter(), []
    while len(times) < repeats or time.perf_counter() - begin < seconds:
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)


def layer(key, seconds):
    """Forward and training in ms, and the FLOP of a forward pass."""
    import torch
    import torch.nn.functional as F

    batch, (kind, c_in, c_out, size, kernel, stride, padding, groups) = key[1], LAYERS[key]
    best = [float("inf")] * 2
    for layout in (torch.contiguous_format, torch.channels_last):
        b = torch.randn(c_out)
        if kind == "linear":
            x, w = torch.randn(batch, c_in), torch.randn(c_out, c_in)
            run = F.linear
        else:
            shape = (c_in, c_out // groups, kernel, kernel) if kind == "transpose" else (c_out, c_in // groups, kernel, kernel)
            x, w = (torch.randn(s).to(memory_format=layout) for s in ((batch, c_in, size, size), shape))
            op = F.conv_transpose2d if kind == "transpose" else F.conv2d
            run = lambda x, w, b: op(x, w, b, stride=stride, padding=padding, groups=groups)
        with torch.no_grad():
            y = run(x, w, b)
            forward = median_ms(lambda: run(x, w, b), seconds)
        tracked = [v.detach().clone(memory_format=torch.preserve_format).requires_grad_() for v in (x, w, b)]
        d = torch.randn_like(y)
        train = median_ms(lambda: torch.autograd.grad(run(*tracked), tracked, d), seconds)
        best = [min(best[0], forward), min(best[1], train)]
        pixels = 1 if kind == "linear" else (x if kind == "transpose" else y)[0, 0].numel()
        flops = 2 * batch * pixels * w.numel()
    return {"forward_ms": best[0], "train_ms": best[1], "flops": flops}


def network(name, seconds):
    import torch
    import torch.nn as nn

    def mlp():
        sizes = [64, 384, 384, 384, 64]
        layers = [m for i in range(4) for m in (nn.Linear(sizes[i], sizes[i + 1]), nn.ReLU())][:-1]
        return nn.Sequential(*layers), (65536, 64)

    def unet():
        from nets_reference import UNet

        return UNet(3, 3, 32, 4, 8), (8, 3, 128, 128)

    def resnet():
        from torchvision.models import resnet18
        from torchvision.ops import FeaturePyramidNetwork

        class Pyramid(nn.Module):
            def __init__(self):
                super().__init__()
                self.r, self.fpn = resnet18(), FeaturePyramidNetwork([64, 128, 256, 512], 64)
                self.r.fc = nn.Identity()

            def forward(self, x):
                r, out = self.r, {}
                y = r.maxpool(r.relu(r.bn1(r.conv1(x))))
                for i in range(4):
                    y = getattr(r, f"layer{i + 1}")(y)
                    out[str(i)] = y
                return list(self.fpn(out).values())

        return Pyramid(), (4, 3, 320, 320)

    def vgg():
        from torchvision.models import vgg16

        return vgg16().features[:-1], (1, 3, 224, 224)

    def vit():
        from torchvision.models import vit_b_32

        net = vit_b_32()
        net.heads = nn.Identity()
        return net, (1, 3, 224, 224)

    make = {"mlp_384_65536": mlp, "unet_128_b8": unet, "resnet18_fpn_320_b4": resnet, "vgg16_224": vgg, "vit_b_32": vit}[name]
    best = [float("inf")] * 2
    layouts = (torch.contiguous_format, torch.channels_last) if name not in ("mlp_384_65536", "vit_b_32") else (torch.contiguous_format,)
    for layout in layouts:
        net, shape = make()
        net, x = net.to(memory_format=layout), torch.rand(shape)
        if len(shape) == 4:
            x = x.contiguous(memory_format=layout)
        net.eval()
        with torch.no_grad():
            best[0] = min(best[0], median_ms(lambda: net(x), seconds))
        net.train()
        optimizer = torch.optim.Adam(net.parameters(), 1e-4)

        def step():
            optimizer.zero_grad(set_to_none=True)
            outputs = net(x)
            sum((out * out).mean() for out in (outputs if isinstance(outputs, list) else [outputs])).backward()
            optimizer.step()

        best[1] = min(best[1], median_ms(step, seconds))
        del net, optimizer, x
    return {"forward_ms": best[0], "train_ms": best[1], "peak_bytes": peak_bytes()}


NETWORKS = ["mlp_384_65536", "unet_128_b8", "resnet18_fpn_320_b4", "vgg16_224", "vit_b_32"]


def peak_bytes():
    """Most memory of this process so far."""
    with open("/proc/self/status") as f:
        return next(int(line.split()[1]) << 10 for line in f if line.startswith("VmHWM"))


def answer(command):
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def rounds(a, name, ours):
    """Medians over rounds in which PyTorch and ours take turns."""
    theirs, own, threads = [], [], ["--threads", str(a.threads), "--seconds", str(a.seconds)]
    for _ in range(a.rounds):
        theirs.append(answer([sys.executable, __file__, "--torch", name, a.ours, *threads]))
        own.append(ours(answer([a.ours, "bench", "nets", name, "--json", *threads])))
    middle = lambda all: {k: statistics.median(v[k] for v in all) for k in all[0] if isinstance(all[0][k], (int, float))}
    return middle(theirs), middle(own)


def compare(a):
    wanted = lambda name: not a.names or any(n in name for n in a.names)
    for key in LAYERS:
        label = f"{key[0]}_b{key[1]}"
        if not wanted(label):
            continue
        exact = lambda report: next(l for l in report["layers"] if (l["name"], l["batch"]) == key)
        theirs, ours = rounds(a, label, exact)
        rate = lambda times, key: times * theirs["flops"] / theirs[key] / a.threads / 1e6
        f, t = rate(1, "forward_ms"), rate(3, "train_ms")
        print(
            f"{label:<24} forward torch {f:6.1f} ours {ours['forward_gflops']:6.1f} ratio {ours['forward_gflops'] / f:.2f}   "
            f"training torch {t:6.1f} ours {ours['train_gflops']:6.1f} ratio {ours['train_gflops'] / t:.2f}",
            flush=True,
        )
    for name in filter(wanted, NETWORKS):
        theirs, ours = rounds(a, name, lambda report: report["networks"][0])
        each = (f"{what} torch {theirs[k]:8.2f} ms ours {ours[k]:8.2f} ms ratio {theirs[k] / ours[k]:.2f}"
                for what, k in (("forward", "forward_ms"), ("training", "train_ms")))
        mib = (round(v["peak_bytes"] / 2**20) for v in (theirs, ours))
        print(f"{name:<22}", *each, "peak torch {} MiB ours {} MiB".format(*mib), flush=True)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("ours", help="the program diorama")
    arguments.add_argument("names", nargs="*", help="parts of names")
    arguments.add_argument("--threads", type=int, default=2)
    arguments.add_argument("--rounds", type=int, default=5)
    arguments.add_argument("--seconds", type=float, default=0.3, help="per figure and round")
    arguments.add_argument("--torch", help="time one layer or network in PyTorch and print JSON")
    a = arguments.parse_intermixed_args()
    if not a.torch:
        return compare(a)
    os.environ["OMP_NUM_THREADS"] = str(a.threads)
    import torch

    torch.set_num_threads(a.threads)
    labels = {f"{name}_b{batch}": (name, batch) for name, batch in LAYERS}
    print(json.dumps(layer(labels[a.torch], a.seconds) if a.torch in labels else network(a.torch, a.seconds)))


if __name__ == "__main__":
    main()
