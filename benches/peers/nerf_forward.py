"""The NeRF network in PyTorch, with the weights that diorama wrote: prints the largest differences.

Usage: nerf_forward.py FOLDER, where FOLDER contains weights.f32, points.f32 [N, 3] in [-1, 1], dirs.f32 [N, 3],
sigma.f32 [N] and rgb.f32 [N, 3], as crates/pipelines/tests/nerf_torch.rs writes them.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from torch import nn


def encode(x, bands, scale):
    out = [x]
    for k in range(bands):
        out += [torch.sin(2.0**k * scale * x), torch.cos(2.0**k * scale * x)]
    return torch.cat(out, -1)


class Nerf(nn.Module):
    """Mildenhall et al. 2020, figure 7; heads are padded to 16 outputs."""

    def __init__(self):
        super().__init__()
        trunk = [nn.Linear(63, 256)]
        trunk += [nn.Linear(256 + (63 if j == 5 else 0), 256) for j in range(1, 8)]
        self.trunk = nn.ModuleList(trunk)
        self.sigma = nn.Linear(256, 16)
        self.feature = nn.Linear(256, 256)
        self.view = nn.Linear(256 + 27, 128)
        self.rgb = nn.Linear(128, 16)

    def forward(self, x, d):
        h = code = encode(x, 10, torch.pi)
        for j, layer in enumerate(self.trunk):
            if j == 5:
                h = torch.cat([code, h], -1)
            h = torch.relu(layer(h))
        sigma = nn.functional.softplus(self.sigma(h)[:, 0])
        v = torch.cat([self.feature(h), encode(d, 4, 1.0)], -1)
        rgb = torch.sigmoid(self.rgb(torch.relu(self.view(v)))[:, :3])
        return sigma, rgb


def main():
    folder = Path(sys.argv[1])
    read = lambda name: torch.from_numpy(np.fromfile(folder / name, dtype="<f4"))
    net, flat, at = Nerf(), read("weights.f32"), 0
    for layer in [*net.trunk, net.sigma, net.feature, net.view, net.rgb]:
        n, k = layer.weight.shape
        layer.weight.data = flat[at : at + n * k].reshape(k, n).T.contiguous()
        layer.bias.data = flat[at + n * k : at + n * k + n].clone()
        at += n * k + n
    assert at == len(flat), (at, len(flat))
    with torch.no_grad():
        sigma, rgb = net(read("points.f32").reshape(-1, 3), read("dirs.f32").reshape(-1, 3))
    d_sigma = (sigma - read("sigma.f32")).abs().max().item()
    d_rgb = (rgb - read("rgb.f32").reshape(-1, 3)).abs().max().item()
    print(f"torch {torch.__version__}: largest difference sigma {d_sigma:.2e}, rgb {d_rgb:.2e}")
    sys.exit(0 if max(d_sigma, d_rgb) <= 1e-4 else 1)


main()
