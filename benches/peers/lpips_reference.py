"""Reference values for the tests of crates/engine/src/metrics/lpips.rs and crates/data/src/weights/mod.rs.

pip install torch lpips; python benches/peers/lpips_reference.py [FOLDER]

Prints the distances that the Python package `lpips` computes with weights from a small generator. The tests use
the same generator, so that no weights are stored and the tests need no Python. With FOLDER, writes one small state_dict there in
both formats of torch.save.
"""

import pathlib
import sys

import lpips
import numpy as np
import torch


def unit(stream: int, n: int) -> np.ndarray:
    """n numbers in [0, 1): a hash of (stream, counter)."""
    with np.errstate(over="ignore"):
        x = np.arange(n, dtype=np.uint64) + np.uint64(stream) * np.uint64(0x9E3779B97F4A7C15)
        for by in (0xBF58476D1CE4E5B9, 0x94D049BB133111EB):
            x = (x ^ (x >> np.uint64(29))) * np.uint64(by)
        x ^= x >> np.uint64(32)
    return (x >> np.uint64(40)).astype(np.float64) / 2.0**24


def fill(tensor: torch.Tensor, stream: int, low: float, high: float) -> None:
    values = (low + (high - low) * unit(stream, tensor.numel())).astype(np.float32)
    with torch.no_grad():
        tensor.copy_(torch.from_numpy(values).reshape(tensor.shape))


def distance(net: str) -> tuple[float, list[float]]:
    model = lpips.LPIPS(net=net, pretrained=False, pnet_rand=True, verbose=False).eval()
    stream = 1
    for name, p in model.net.named_parameters():
        if name.endswith("weight"):
            bound = (6.0 / (p.shape[1] * p.shape[2] * p.shape[3])) ** 0.5
            fill(p, stream, -bound, bound)
        else:
            fill(p, stream, -0.05, 0.05)
        stream += 1
    for lin in model.lins:
        fill(lin.model[1].weight, stream, 0.0, 1.0)
        stream += 1
    pictures = [torch.from_numpy(unit(k, 3 * 48 * 64).astype(np.float32)).reshape(1, 48, 64, 3) for k in (100, 101)]
    # A gradient with less and with more noise.
    y, x = torch.meshgrid(torch.arange(48) / 48, torch.arange(64) / 64, indexing="ij")
    base = torch.stack([x, y, 0.5 * (x + y)], -1)[None].to(torch.float32)
    a, b = (0.8 * base + share * noise for share, noise in zip((0.05, 0.2), pictures))
    with torch.no_grad():
        value, parts = model(a.permute(0, 3, 1, 2), b.permute(0, 3, 1, 2), normalize=True, retPerLayer=True)
    return value.item(), [p.item() for p in parts]


def small(folder: pathlib.Path) -> None:
    state = torch.nn.Sequential(torch.nn.Conv2d(2, 3, 2), torch.nn.BatchNorm2d(3)).state_dict()
    for k, (name, p) in enumerate(state.items()):
        if p.is_floating_point():
            fill(p, k, -1.0, 1.0)
    state["half"] = torch.tensor([1.0, -0.5, 65504.0, 6e-8], dtype=torch.float16)
    state["brain"] = torch.tensor([1.0, -2.5], dtype=torch.bfloat16)
    state["double"] = torch.tensor([0.1], dtype=torch.float64)
    state["part"] = torch.arange(10, dtype=torch.float32)[4:7]
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(state, folder / "small.pth")
    torch.save(state, folder / "small_legacy.pth", _use_new_zipfile_serialization=False)
    for name, p in state.items():
        print(name, list(p.shape), p.flatten()[:4].tolist())


if __name__ == "__main__":
    torch.set_num_threads(1)
    if len(sys.argv) > 1:
        small(pathlib.Path(sys.argv[1]))
    else:
        for net in ("alex", "vgg"):
            print(net, *distance(net))
