"""The scene model of Rudnev et al. 2022 in PyTorch, trained on rays and samples that diorama recorded: prints both losses, and how far the
parameters end from each other.

Usage: relight_torch.py FOLDER, as crates/pipelines/tests/relight_torch.rs writes it. Normals are gradients of the density, which are
differentiated once more.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from torch import nn

# On a busy machine, several threads wait for each other for minutes.
torch.set_num_threads(1)

BANDS, WIDTH = 12, 256
GRAY = torch.tensor([0.2126, 0.7152, 0.0722])
FACTORS = [0.282095, 0.488603, 0.488603, 0.488603, 1.092548, 1.092548, 0.315392, 1.092548, 0.546274]
# Rounding errors grow with each step; a wrong formula moves the parameters by about 100 %.
MOST, APART, SHORT = 0.01, 0.25, 0.05


def encode(x, step):
    admitted = 8 + (BANDS - 8) * min(step / 30_000, 1)
    out = [x]
    for k in range(BANDS):
        w = 0.5 * (1 - np.cos(np.pi * np.clip(admitted - k, 0, 1)))
        out += [w * torch.sin(2.0**k * x), w * torch.cos(2.0**k * x)]
    return torch.cat(out, -1)


class Network(nn.Module):
    """Eight layers with a skip, a density, a feature, and heads; outputs are padded to 16."""

    def __init__(self, dims, heads):
        super().__init__()
        code = dims * (1 + 2 * BANDS)
        self.trunk = nn.ModuleList([nn.Linear((code if j in (0, 5) else 0) + (WIDTH if j else 0), WIDTH) for j in range(8)])
        self.sigma, self.feature = nn.Linear(WIDTH, 16), nn.Linear(WIDTH, WIDTH)
        self.heads = nn.ModuleList()
        for given in heads:
            self.heads += [nn.Linear(WIDTH + given, WIDTH // 2), nn.Linear(WIDTH // 2, 16)]

    def layers(self):
        return [*self.trunk, self.sigma, self.feature, *self.heads]

    def flat(self):
        return torch.cat([v.detach().reshape(-1) for l in self.layers() for v in (l.weight.T, l.bias)])

    def load(self, flat):
        at = 0
        for layer in self.layers():
            n, k = layer.weight.shape
            layer.weight.data = flat[at : at + n * k].reshape(k, n).T.contiguous()
            layer.bias.data = flat[at + n * k : at + n * k + n].clone()
            at += n * k + n
        assert at == len(flat), (at, len(flat))

    def density(self, x, step):
        h = code = encode(x, step)
        for j, layer in enumerate(self.trunk):
            h = torch.relu(layer(torch.cat([code, h], -1) if j == 5 else h))
        return torch.relu(self.sigma(h)[..., 0]), self.feature(h)

    def head(self, i, inputs):
        return torch.sigmoid(self.heads[2 * i + 1](torch.relu(self.heads[2 * i](inputs))))


def composite(sigma, dt):
    alpha = 1 - torch.exp(-sigma * dt)
    through = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], -1), -1)
    return alpha * through[:, :-1], through[:, -1]


def basis(n):
    x, y, z = n.unbind(-1)
    terms = [torch.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    return torch.stack([f * t for f, t in zip(FACTORS, terms)], -1)


class Level:
    def __init__(self, folder, name, rays, radius, first):
        read = lambda part: torch.from_numpy(np.fromfile(folder / f"{name}.{part}", dtype="<f4"))
        self.name, self.read = name, read
        self.net, self.outer = Network(3, [0, 9]), Network(4, [0])
        self.net.load(read("weights"))
        self.outer.load(read("background"))
        self.lights = nn.Parameter(read("lights").reshape(-1, 9, 3))
        steps = len(read("noise")) // (9 * rays)
        shape = lambda part, *tail: read(part).reshape(steps, rays, -1, *tail)
        self.t, self.dt, self.points, self.far = shape("t"), shape("dt"), shape("points", 4), shape("outer")
        self.noise, self.radius, self.first = read("noise").reshape(steps, rays, 9), radius, first

    def apart(self):
        """Distance between both ends of training, as a share of the way there: of networks and of lights."""
        ends = {"weights": self.net.flat(), "background": self.outer.flat(), "lights": self.lights.detach().reshape(-1)}
        share = lambda part, end: ((end - self.read(part + ".end")).norm() / (end - self.read(part)).norm()).item()
        shares = {part: share(part, end) for part, end in ends.items()}
        print(self.name, {part: f"{100 * s:.2f} %" for part, s in shares.items()})
        return max(shares.values())

    def loss(self, s, origins, dirs, target, light):
        step, t, dt = self.first + s, self.t[s], self.dt[s]
        x = (origins[:, None] + (t + 0.5 * dt)[..., None] * dirs[:, None] - 0.5) / self.radius
        x.requires_grad_(True)
        sigma, feature = self.net.density(x, step)
        (slope,) = torch.autograd.grad(sigma.sum(), x, create_graph=True)
        weights, through = composite(sigma, dt)
        table = self.lights[light]
        code = (table * GRAY).sum(-1) + self.noise[s]
        albedo = (weights[..., None] * self.net.head(0, feature)[..., :3]).sum(1)
        code = code[:, None].expand(-1, t.shape[1], -1)
        shadow = (weights * self.net.head(1, torch.cat([feature, code], -1))[..., 0]).sum(1) + through
        normal = -(weights[..., None] * slope / self.radius).sum(1)
        normal = normal / (normal.square().sum(-1, keepdim=True) + SHORT**2).sqrt()
        lit = (table * basis(normal)[..., None]).sum(1).clamp(min=1e-5) ** (1 / 2.2)
        far_sigma, far_feature = self.outer.density(self.points[s], step)
        far_weights, _ = composite(far_sigma, self.far[s])
        behind = (far_weights[..., None] * self.outer.head(0, far_feature)[..., :3]).sum(1)
        color = shadow[:, None] * albedo * lit + through[:, None] * behind
        held = 0.01 * min(max((step - 10_000) / 20_000, 0), 1)
        return ((color - target) ** 2).mean() + held * ((1 - shadow) ** 2).mean()


def main():
    folder = Path(sys.argv[1])
    read = lambda name: torch.from_numpy(np.fromfile(folder / name, dtype="<f4"))
    want = read("losses")
    steps, rays = len(want), len(read("light")) // len(want)
    origins, dirs = read("origins").reshape(steps, rays, 3), read("dirs").reshape(steps, rays, 3)
    target, light = read("target").reshape(steps, rays, 4)[..., :3], read("light").reshape(steps, rays).long()
    first, rate, light_rate = read("rates").tolist()
    levels = [Level(folder, name, rays, read("radius").item(), first) for name in ("coarse", "fine")]
    nets = [p for l in levels for n in (l.net, l.outer) for p in n.parameters()]
    tables = [l.lights for l in levels]
    optimizer = torch.optim.Adam([{"params": nets, "lr": rate}, {"params": tables, "lr": light_rate}], eps=1e-8)
    for p in [*nets, *tables]:
        # Moments are corrected by the number of the step, on both sides.
        moments = {"exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
        optimizer.state[p] = {"step": torch.tensor(first), **moments}
    worst = 0.0
    for s in range(steps):
        loss = sum(l.loss(s, origins[s], dirs[s], target[s], light[s]) for l in levels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        off = abs(loss.item() - want[s].item()) / want[s].item()
        worst = max(worst, off)
        if s % 10 == 9 or s == 0:
            print(f"step {s + 1}: torch {loss.item():.5f}, diorama {want[s].item():.5f}, off by {100 * off:.3f} %")
    print(f"torch {torch.__version__}: largest difference {100 * worst:.3f} % in {steps} steps")
    moved = max(l.apart() for l in levels)
    print(f"parameters end apart by at most {100 * moved:.2f} % of how far they went")
    sys.exit(0 if worst <= MOST and moved <= APART else 1)


main()
