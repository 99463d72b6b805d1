"""EAST and DB at reduced width in PyTorch: random weights, an image, targets, outputs in evaluation, and of one step of training the loss
and the gradients of all weights, as the fixtures of crates/nets/src/modules/detector_tests.rs. Run it with PyTorch:

    python benches/peers/detectors_reference.py crates/nets/tests/data
"""

import json
import math
import struct
import sys
from pathlib import Path

import torch
import torch.nn as nn
import torch.nn.functional as F


def save(path, tensors):
    """Writes safetensors."""
    header, data = {}, b""
    for name, t in tensors.items():
        raw = t.detach().contiguous().to(torch.float32).numpy().tobytes()
        header[name] = {"dtype": "F32", "shape": list(t.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)
    print(f"{path}: {path.stat().st_size} bytes")


def randomize(net):
    """Weights and statistics that are neither zero nor one."""
    for name, t in net.state_dict().items():
        if t.dtype != torch.float32:
            continue
        if name.endswith("running_var"):
            t.uniform_(0.5, 1.5)
        elif t.dim() > 1:
            t.normal_(0, (1.5 / t[0].numel()) ** 0.5)
        elif name.endswith("weight"):
            t.uniform_(0.7, 1.3)
        else:
            t.normal_(0, 0.2)


def normed(a, b, kernel, stride=1):
    """A convolution and its normalization; callers add the ReLU."""
    return nn.Sequential(nn.Conv2d(a, b, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(b))


class Block(nn.Module):
    """A residual block of two 3×3 convolutions, or of three with a narrow middle."""

    def __init__(self, a, width, stride, bottleneck):
        super().__init__()
        if bottleneck:
            plan = [(a, width, 1, 1), (width, width, 3, stride), (width, 4 * width, 1, 1)]
        else:
            plan = [(a, width, 3, stride), (width, width, 3, 1)]
        self.depth, b = len(plan), plan[-1][1]
        for i, (c, d, kernel, s) in enumerate(plan):
            setattr(self, f"conv{i + 1}", nn.Conv2d(c, d, kernel, s, kernel // 2, bias=False))
            setattr(self, f"bn{i + 1}", nn.BatchNorm2d(d))
        self.downsample = normed(a, b, 1, stride) if stride != 1 or a != b else None

    def forward(self, x):
        y = x
        for i in range(1, self.depth + 1):
            y = getattr(self, f"bn{i}")(getattr(self, f"conv{i}")(y))
            y = F.relu(y) if i < self.depth else y
        return F.relu(y + (x if self.downsample is None else self.downsample(x)))


class Backbone(nn.Module):
    def __init__(self, width, blocks, bottleneck):
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.channels, c = [], width
        for stage, n in enumerate(blocks):
            layers = []
            for i in range(n):
                layers.append(Block(c, width << stage, 2 if stage > 0 and i == 0 else 1, bottleneck))
                c = (width << stage) * (4 if bottleneck else 1)
            setattr(self, f"layer{stage + 1}", nn.Sequential(*layers))
            self.channels.append(c)

    def forward(self, x):
        mean, std = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
        x = (x - torch.tensor(mean).to(x).view(1, 3, 1, 1)) / torch.tensor(std).to(x).view(1, 3, 1, 1)
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        out = []
        for i in range(4):
            x = getattr(self, f"layer{i + 1}")(x)
            out.append(x)
        return out


class East(nn.Module):
    def __init__(self, backbone, widths):
        super().__init__()
        self.backbone = backbone
        merges, a = [], backbone.channels[3]
        for width, c in zip(widths, reversed(backbone.channels[:3])):
            merges.append(nn.ModuleList([normed(a + c, width, 1), normed(width, width, 3)]))
            a = width
        self.merges = nn.ModuleList(merges)
        self.last = normed(a, a, 3)
        self.head = nn.Conv2d(a, 6, 1)

    def forward(self, x):
        *finer, x = self.backbone(x)
        for feature, (reduce, smooth) in zip(reversed(finer), self.merges):
            x = F.interpolate(x, feature.shape[2:], mode="bilinear", align_corners=False)
            x = F.relu(smooth(F.relu(reduce(torch.cat([x, feature], 1)))))
        x = torch.sigmoid(self.head(F.relu(self.last(x))))
        return [x[:, :1], torch.cat([x[:, 1:5] * 512, (x[:, 5:] - 0.5) * math.pi], 1)]


class Head(nn.Module):
    def __init__(self, a, width):
        super().__init__()
        self.first = normed(a, width, 3)
        self.grow = nn.ConvTranspose2d(width, width, 2, 2, bias=False)
        self.norm = nn.BatchNorm2d(width)
        self.last = nn.ConvTranspose2d(width, 1, 2, 2)

    def forward(self, x):
        return torch.sigmoid(self.last(F.relu(self.norm(self.grow(F.relu(self.first(x)))))))


class Pyramid(nn.Module):
    def __init__(self, channels, inner, level):
        super().__init__()
        self.inner_blocks = nn.ModuleList([nn.Sequential(nn.Conv2d(c, inner, 1)) for c in channels])
        self.layer_blocks = nn.ModuleList([nn.Sequential(nn.Conv2d(inner, level, 3, 1, 1)) for _ in channels])

    def forward(self, features):
        out, above = [], None
        for x, inner, layer in reversed(list(zip(features, self.inner_blocks, self.layer_blocks))):
            x = inner(x)
            if above is not None:
                x = x + F.interpolate(above, x.shape[2:], mode="nearest")
            above = x
            out.insert(0, layer(x))
        return out


class Db(nn.Module):
    def __init__(self, backbone, inner, level):
        super().__init__()
        self.backbone = backbone
        self.pyramid = Pyramid(backbone.channels, inner, level)
        self.probability, self.threshold = Head(4 * level, level), Head(4 * level, level)

    def forward(self, x):
        levels = self.pyramid(self.backbone(x))
        x = torch.cat([F.interpolate(l, levels[0].shape[2:], mode="nearest") for l in levels], 1)
        return [self.probability(x), self.threshold(x)]


def dice(a, b, epsilon=1e-5):
    return 1 - 2 * (a * b).sum() / (a.sum() + b.sum() + epsilon)


def east_loss(maps, truth):
    score, p = maps
    wanted, weight, g = truth
    wanted = wanted * weight
    shared = torch.minimum(p[:, :4], g[:, :4])
    area = lambda d: (d[:, 0] + d[:, 2]) * (d[:, 1] + d[:, 3])  # noqa: E731
    inside = area(shared)
    union = area(p) + area(g) - inside
    iou = -torch.log((inside + 1) / (union + 1)).unsqueeze(1)
    angle = 1 - torch.cos(p[:, 4:] - g[:, 4:])
    n = wanted.sum()
    return dice(score * weight, wanted) + (iou * wanted).sum() / n + 10 * (angle * wanted).sum() / n


def db_loss(maps, truth):
    p, t = maps
    shrunk, weight, threshold, threshold_weight = truth
    binary = torch.sigmoid(50 * (p - t))
    l1 = ((t - threshold).abs() * threshold_weight).sum() / (threshold_weight.sum() + 1e-6)
    entropy = F.binary_cross_entropy(p, shrunk, reduction="none")
    positive, negative = shrunk * weight > 0.5, (1 - shrunk) * weight > 0.5
    n = int(positive.sum())
    k = min(int(negative.sum()), 3 * n)
    hard = entropy[negative].topk(k).values
    bce = (entropy[positive].sum() + hard.sum()) / (n + k + 1e-6)
    return dice(binary * weight, shrunk * weight) + 10 * l1 + 5 * bce


def fixture(folder, name, net, truth, loss, shown):
    """Outputs in evaluation, then a step's loss and gradients; numbers of 32 bits, computed in 64. Truth stands for itself, not for an
    image's content."""
    randomize(net)
    net, truth = net.double(), [t.double() for t in truth]
    image = torch.rand(2, 3, 64, 64).double()
    out = {f"net.{k}": v.clone() for k, v in net.state_dict().items() if v.dtype == torch.float64}
    out |= {"image": image} | {f"truth.{i}": t for i, t in enumerate(truth)}
    net.eval()
    with torch.no_grad():
        out |= {f"eval.{i}": t for i, t in enumerate(net(image)[:shown])}
    net.train()
    value = loss(net(image), truth)
    value.backward()
    out["loss"] = value.reshape(1)
    out |= {f"grad.{k}": v.grad for k, v in net.named_parameters()}
    save(folder / f"{name}.safetensors", out)


def blobs(n, h, w):
    """1 in about a fifth of the pixels, in patches."""
    coarse = F.interpolate(torch.randn(n, 1, 4, 4), (h, w), mode="bilinear", align_corners=False)
    return (coarse > 0.6).float()


def main(folder):
    torch.manual_seed(3)
    distances = torch.rand(2, 4, 16, 16) * 300 + 50
    geometry = torch.cat([distances, torch.rand(2, 1, 16, 16) * 2 - 1], 1)
    weight = (torch.rand(2, 1, 16, 16) > 0.1).float()
    truth = [blobs(2, 16, 16), weight, geometry]
    fixture(folder, "east", East(Backbone(2, [1, 1, 1, 1], False), [4, 3, 2]), truth, east_loss, 2)
    weight = (torch.rand(2, 1, 64, 64) > 0.1).float()
    truth = [blobs(2, 64, 64), weight, torch.rand(2, 1, 64, 64) * 0.4 + 0.3, blobs(2, 64, 64)]
    fixture(folder, "db", Db(Backbone(2, [1, 1, 1, 1], False), 4, 2), truth, db_loss, 1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
