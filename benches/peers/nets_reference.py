"""Networks at reduced width in PyTorch: random weights, inputs, outputs, and gradients of the inputs, as the fixtures of
crates/nets/src/modules/tests.rs. Run it with PyTorch and torchvision:

    python benches/peers/nets_reference.py crates/nets/tests/data
"""

import json
import struct
import sys
from pathlib import Path

import torch
import torch.nn as nn
import torch.nn.functional as F
from torchvision.models.resnet import BasicBlock, Bottleneck
from torchvision.models.vgg import VGG, make_layers
from torchvision.models.vision_transformer import VisionTransformer
from torchvision.ops import FeaturePyramidNetwork


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


def fixture(folder, name, net, inputs, run):
    """Outputs in evaluation, then in training, with the inputs' gradients of a weighted sum; numbers of 32 bits, computed in 64."""
    randomize(net)
    net, inputs = net.double(), [t.double() for t in inputs]
    out = {f"net.{k}": v.clone() for k, v in net.state_dict().items() if v.dtype == torch.float64}
    out |= {f"in.{i}": t for i, t in enumerate(inputs)}
    net.eval()
    with torch.no_grad():
        results = run(net, *inputs)
    out |= {f"eval.{i}": t for i, t in enumerate(results)}
    net.train()
    leaves = [t.clone().requires_grad_() for t in inputs]
    results = run(net, *leaves)
    torch.manual_seed(5)
    weights = [torch.randn(t.shape).double() for t in results]
    sum((t * w).sum() for t, w in zip(results, weights)).backward()
    out |= {f"train.{i}": t for i, t in enumerate(results)}
    out |= {f"weight.{i}": t for i, t in enumerate(weights)}
    out |= {f"d_in.{i}": t.grad for i, t in enumerate(leaves)}
    save(folder / f"{name}.safetensors", out)


class ResNetFpn(nn.Module):
    """torchvision's residual blocks at any width, with its pyramid."""

    def __init__(self, block, blocks, width, out):
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        channels, features = width, []
        for stage, n in enumerate(blocks):
            layers = []
            for i in range(n):
                planes, stride = width << stage, 2 if stage > 0 and i == 0 else 1
                down = None
                if stride != 1 or channels != planes * block.expansion:
                    down = nn.Sequential(
                        nn.Conv2d(channels, planes * block.expansion, 1, stride, bias=False), nn.BatchNorm2d(planes * block.expansion)
                    )
                layers.append(block(channels, planes, stride, down))
                channels = planes * block.expansion
            features.append(channels)
            setattr(self, f"layer{stage + 1}", nn.Sequential(*layers))
        self.fpn = FeaturePyramidNetwork(features, out)

    def forward(self, x):
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        features = {}
        for i in range(4):
            x = getattr(self, f"layer{i + 1}")(x)
            features[str(i)] = x
        return list(self.fpn(features).values())


class Double(nn.Sequential):
    def __init__(self, a, b, groups):
        super().__init__(
            nn.Conv2d(a, b, 3, 1, 1, bias=False), nn.GroupNorm(groups, b), nn.ReLU(),
            nn.Conv2d(b, b, 3, 1, 1, bias=False), nn.GroupNorm(groups, b), nn.ReLU(),
        )  # fmt: skip


class UNet(nn.Module):
    def __init__(self, inputs, outputs, width, depth, groups):
        super().__init__()
        w = [width << i for i in range(depth + 1)]
        self.down = nn.ModuleList([Double(inputs if i == 0 else w[i - 1], w[i], groups) for i in range(depth + 1)])
        self.up = nn.ModuleList([Double(w[i + 1] + w[i], w[i], groups) for i in reversed(range(depth))])
        self.head = nn.Conv2d(width, outputs, 1)

    def forward(self, x):
        known = []
        for i, part in enumerate(self.down):
            if i > 0:
                known.append(x)
                x = F.max_pool2d(x, 2)
            x = part(x)
        for part in self.up:
            skip = known.pop()
            x = F.interpolate(x, skip.shape[2:], mode="bilinear", align_corners=False)
            x = part(torch.cat([skip, x], 1))
        return self.head(x)


class RendererBlock(nn.Module):
    def __init__(self, width, codes):
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv2d(width, width, 3, 1, 1) for _ in range(2))
        self.scale, self.shift = (nn.Linear(codes, width) for _ in range(2))

    def forward(self, x, code):
        y = self.conv1(x) * (1 + self.scale(code)[..., None, None]) + self.shift(code)[..., None, None]
        return x + self.conv2(F.leaky_relu(y, 0.2))


class Renderer(nn.Module):
    def __init__(self, inputs, codes, width, blocks, scale):
        super().__init__()
        self.stem = nn.Conv2d(inputs, width, 3, 1, 1)
        self.blocks = nn.ModuleList([RendererBlock(width, codes) for _ in range(blocks)])
        self.head = nn.Conv2d(width, 3 * scale * scale, 3, 1, 1)
        self.grow = nn.PixelShuffle(scale)

    def forward(self, x, code):
        x = F.leaky_relu(self.stem(x), 0.2)
        for block in self.blocks:
            x = block(x, code)
        return torch.sigmoid(self.grow(self.head(x)))


class SpectralConv(nn.Module):
    """torch.nn.utils.spectral_norm with plain names."""

    def __init__(self, a, b, stride):
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.empty(b, a, 4, 4)), nn.Parameter(torch.empty(b))
        self.register_buffer("u", torch.empty(b))
        self.register_buffer("v", torch.empty(a * 16))
        self.stride = stride

    def forward(self, x):
        w = self.weight.flatten(1)
        with torch.no_grad():
            if self.training:
                self.v.copy_(F.normalize(w.T @ self.u, dim=0))
                self.u.copy_(F.normalize(w @ self.v, dim=0))
            u, v = self.u.clone(), self.v.clone()
        return F.conv2d(x, self.weight / (u @ w @ v), self.bias, self.stride, 1)


class Discriminator(nn.Module):
    def __init__(self, inputs, width, halvings):
        super().__init__()
        c = [inputs] + [width << min(i, 3) for i in range(halvings + 1)] + [1]
        self.convs = nn.ModuleList([SpectralConv(c[i], c[i + 1], 2 if i < halvings else 1) for i in range(len(c) - 1)])

    def forward(self, x):
        for conv in self.convs[:-1]:
            x = F.leaky_relu(conv(x), 0.2)
        return self.convs[-1](x)


def main(folder):
    torch.manual_seed(1)
    one = lambda net, *x: [net(*x)]  # noqa: E731
    image = lambda n, h, w, c=3: torch.randn(n, c, h, w)  # noqa: E731
    fixture(folder, "resnet18_fpn", ResNetFpn(BasicBlock, [2, 2, 2, 2], 2, 2), [image(2, 33, 20)], lambda net, x: net(x))
    fixture(folder, "resnet50_fpn", ResNetFpn(Bottleneck, [1, 2, 1, 1], 1, 2), [image(2, 33, 33)], lambda net, x: net(x))
    fixture(folder, "unet", UNet(3, 2, 4, 2, 2), [image(2, 16, 12)], one)

    cfg = [1 << min(i, 3) for i in range(5)]
    for name, convs in [("vgg16", [2, 2, 3, 3, 3]), ("vgg19", [2, 2, 4, 4, 4])]:
        layers = [c for i, n in enumerate(convs) for c in [cfg[i]] * n + ["M"]]
        net = VGG(make_layers(layers[:-1]), num_classes=1)
        net.classifier = net.avgpool = nn.Identity()
        wanted = {"vgg16": [3, 8, 15, 22, 29], "vgg19": [3, 8, 17, 26, 35]}[name]

        def features(net, x, wanted=wanted):
            out = []
            for i, layer in enumerate(net.features):
                x = layer(x.clone() if isinstance(layer, nn.ReLU) else x)
                if i in wanted:
                    out.append(x)
            return out

        fixture(folder, name, net, [image(1, 32, 32)], features)
    vit = VisionTransformer(image_size=16, patch_size=8, num_layers=2, num_heads=2, hidden_dim=12, mlp_dim=20)

    def tokens(net, x):
        x = net._process_input(x)
        return [net.encoder(torch.cat([net.class_token.expand(x.shape[0], -1, -1), x], 1))]

    vit.heads = nn.Identity()
    fixture(folder, "vit", vit, [image(2, 16, 16)], tokens)
    fixture(folder, "renderer", Renderer(5, 6, 8, 2, 2), [image(2, 7, 6, 5), torch.randn(2, 6)], one)
    discriminator = Discriminator(3, 4, 2)
    fixture(folder, "discriminator", discriminator, [image(2, 32, 28)], one)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
