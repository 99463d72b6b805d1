"""Reads what `diorama relight compose --export-blender DIR` writes, for other renderers, and compares pictures."""
import json
import os
import struct
import subprocess

import numpy as np

COMPONENTS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# From glTF's world (y up) to that of scene.json (z up).
Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)


def export(diorama, scene, folder):
    """Exports a composition, and renders one sample of it because the command always renders; returns scene.json."""
    command = [diorama, "relight", "compose", scene, "--spp", "1", "--export-blender", folder, "-o", folder + ".exr", "--force"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    with open(os.path.join(folder, "scene.json"), encoding="utf-8") as f:
        return json.load(f)


class Glb:
    """A .glb that diorama wrote: one primitive per mesh, one buffer, embedded PNG images."""

    def __init__(self, path):
        with open(path, "rb") as f:
            data = f.read()
        length = struct.unpack_from("<I", data, 12)[0]
        self.root = json.loads(data[20 : 20 + length])
        self.binary = data[28 + length :]

    def view(self, index):
        view = self.root["bufferViews"][index]
        start = view.get("byteOffset", 0)
        return self.binary[start : start + view["byteLength"]], view.get("byteStride")

    def accessor(self, index):
        a = self.root["accessors"][index]
        data, stride = self.view(a["bufferView"])
        kind, width = np.dtype(COMPONENTS[a["componentType"]]), WIDTHS[a["type"]]
        stride = stride or kind.itemsize * width
        start = a.get("byteOffset", 0)
        rows = np.ndarray((a["count"], width), kind, data, start, (stride, kind.itemsize))
        return rows.copy()

    def image(self, texture):
        return self.view(self.root["images"][self.root["textures"][texture]["source"]]["bufferView"])[0]

    def placed(self):
        """World matrix (z up) and primitive of each node."""
        for node in self.root["nodes"]:
            if "mesh" not in node:
                continue
            yield Z_UP @ matrix(node), self.root["meshes"][node["mesh"]]["primitives"][0]


def matrix(node):
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = node.get("rotation", [0, 0, 0, 1])
    m = np.eye(4)
    m[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    m[:3, :3] *= np.array(node.get("scale", [1, 1, 1]), float)[None, :]
    m[:3, 3] = node.get("translation", [0, 0, 0])
    return m


def write_ply(path, matrix, positions, normals, uvs, triangles):
    """Binary PLY in the world, with normals and texture coordinates (v downward) where there are some."""
    count = len(positions)
    columns = {"x y z": positions @ matrix[:3, :3].T + matrix[:3, 3]}
    if normals is not None:
        turned = normals @ np.linalg.inv(matrix[:3, :3])
        columns["nx ny nz"] = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-20)
    if uvs is not None:
        columns["u v"] = uvs
    names = " ".join(columns).split()
    if np.linalg.det(matrix[:3, :3]) < 0:
        triangles = triangles[:, [0, 2, 1]]
    faces = np.empty(len(triangles), [("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *[f"property float {n}" for n in names]]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header\n"]
    with open(path, "wb") as f:
        f.write("\n".join(header).encode())
        f.write(np.concatenate(list(columns.values()), 1).astype("<f4").tobytes())
        f.write(faces.tobytes())


def gain(linear):
    """Brings the brightest twentieth near white, as diorama exposes PNG files."""
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    return 0.85 / np.quantile(luminance, 0.95)


def srgb(linear):
    v = np.clip(linear, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)


def psnr(ours, theirs):
    """PSNR of two linear pictures [H, W, 3] as sRGB at one exposure, and the ratio of their means (ours / theirs)."""
    k = gain(ours)
    error = np.mean((srgb(k * ours) - srgb(k * theirs)) ** 2)
    return -10 * np.log10(error), ours.mean() / theirs.mean()
