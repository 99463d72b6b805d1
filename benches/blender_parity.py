"""Renders a composition with diorama and its export with Blender's Cycles, and compares the pictures.

    pip install mitsuba numpy        (mitsuba reads the .exr files)
    python3 benches/blender_parity.py scene.toml [--diorama target/release/diorama] [--blender blender] [--spp 512]

Prints PSNR as sRGB at one exposure, and the ratio of the linear means.
"""
import argparse
import os
import subprocess
import sys
import tempfile

import mitsuba as mi
import numpy as np

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "peers"))
from exported_scene import export, psnr  # noqa: E402


def read(path):
    return np.array(mi.Bitmap(path).convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.Float32, srgb_gamma=False), dtype=np.float64)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scene")
    parser.add_argument("--diorama", default="target/release/diorama")
    parser.add_argument("--blender", default="blender")
    parser.add_argument("--spp", type=int, default=512)
    parser.add_argument("--principled", action="store_true", help="materials as Blender imports them")
    parser.add_argument("--keep", metavar="DIR", help="where the two pictures go")
    options = parser.parse_args()
    mi.set_variant("scalar_rgb")
    with tempfile.TemporaryDirectory() as temporary:
        folder, keep = os.path.join(temporary, "scene"), options.keep or temporary
        os.makedirs(keep, exist_ok=True)
        export(options.diorama, options.scene, folder)
        ours, theirs = os.path.join(keep, "diorama.exr"), os.path.join(keep, "blender.exr")
        quiet = {"check": True, "stdout": subprocess.DEVNULL}
        compose = [options.diorama, "relight", "compose", options.scene, "--spp", str(options.spp), "--denoise", "off", "--force", "-o", ours]
        subprocess.run(compose, stderr=subprocess.DEVNULL, **quiet)
        script = os.path.join(folder, "scene.py")
        subprocess.run([options.blender, "-b", "--python-exit-code", "1", "-P", script, "--", "--render", theirs, "--samples", str(options.spp), *(["--principled"] if options.principled else [])], **quiet)
        a, b = read(ours)[..., :3], read(theirs)[..., :3]
        decibels, ratio = psnr(a, b)
        print(f"{options.scene}: {decibels:.2f} dB, mean x {ratio:.4f} at {options.spp} samples per pixel")


main()
