"""Times the networks of `crates/nets/examples/nets-speed.rs` in PyTorch and ours in one call, and prints the ratios.

    cargo build --release -p diorama-nets --example nets-speed
    python benches/peers/networks_torch.py target/release/examples/nets-speed [--threads N] [NAME...]
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time

import torch
import torch.nn as nn
import torch.nn.functional as F


def median(run):
    for _ in range(2):
        run()
    begin, times = time.perf_counter(), []
    while len(times) < 5 or (len(times) < 40 and time.perf_counter() - begin < 5):
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)


def training(net, forward):
    optimizer = torch.optim.Adam(net.parameters(), 1e-4)

    def step():
        optimizer.zero_grad(set_to_none=True)
        sum((out * out).mean() for out in forward()).backward()
        optimizer.step()

    return median(step)


def best(run):
    """The better of PyTorch's two layouts."""
    return min(run(torch.contiguous_format), run(torch.channels_last))


def mlp():
    net = nn.Sequential(nn.Linear(64, 384), nn.ReLU(), nn.Linear(384, 384), nn.ReLU(), nn.Linear(384, 384), nn.ReLU(), nn.Linear(384, 64))
    x = torch.rand(65536, 64)
    return training(net, lambda: [net(x)])


def unet():
    from nets_reference import UNet

    def run(layout):
        net = UNet(3, 3, 32, 4, 8).to(memory_format=layout)
        x = torch.rand(8, 3, 128, 128).contiguous(memory_format=layout)
        return training(net, lambda: [net(x)])

    return best(run)


def resnet():
    from torchvision.models import resnet18
    from torchvision.ops import FeaturePyramidNetwork

    def run(layout):
        net = nn.ModuleList([resnet18(), FeaturePyramidNetwork([64, 128, 256, 512], 64)]).to(memory_format=layout)
        x = torch.rand(4, 3, 320, 320).contiguous(memory_format=layout)

        def forward():
            r, out = net[0], {}
            y = r.maxpool(r.relu(r.bn1(r.conv1(x))))
            for i in range(4):
                y = getattr(r, f"layer{i + 1}")(y)
                out[str(i)] = y
            return list(net[1](out).values())

        return training(net, forward)

    return best(run)


def inference(make):
    def run(layout):
        net = make().eval().to(memory_format=layout)
        x = torch.rand(1, 3, 224, 224).contiguous(memory_format=layout)
        with torch.no_grad():
            return median(lambda: net(x))

    return best(run)


def vgg():
    from torchvision.models import vgg16

    return inference(lambda: vgg16().features)


def vit():
    from torchvision.models import vit_b_32

    def make():
        net = vit_b_32()
        net.heads = nn.Identity()
        return net

    return inference(make)


CASES = {"mlp_384_65536": mlp, "unet_128_b8": unet, "resnet18_fpn_320_b4": resnet, "vgg16_224": vgg, "vit_b_32": vit}


def peak_mib():
    """Most memory of this process so far."""
    with open("/proc/self/status") as f:
        return next(int(line.split()[1]) >> 10 for line in f if line.startswith("VmHWM"))


def run_alone(command, threads):
    """What a process of its own prints, so that its peak memory is that of one network."""
    env = os.environ | {"RAYON_NUM_THREADS": str(threads)}
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True, env=env).stdout)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("ours", help="the example nets-speed, or `torch` to time one network here")
    arguments.add_argument("names", nargs="*")
    arguments.add_argument("--threads", type=int, default=2)
    a = arguments.parse_args()
    torch.set_num_threads(a.threads)
    if a.ours == "torch":
        print(json.dumps({"ms": CASES[a.names[0]](), "peak_mib": peak_mib()}))
        return
    for name in CASES:
        if a.names and name not in a.names:
            continue
        theirs = run_alone([sys.executable, __file__, "torch", name, "--threads", str(a.threads)], a.threads)
        ours = run_alone([a.ours, name], a.threads)
        ratio, memory = theirs["ms"] / ours["ms"], f"{theirs['peak_mib']} MiB, ours {ours['peak_mib']} MiB"
        print(f"{name:<22} torch {theirs['ms']:9.2f} ms  ours {ours['ms']:9.2f} ms  ratio {ratio:.2f}  peak torch {memory}", flush=True)


if __name__ == "__main__":
    main()
