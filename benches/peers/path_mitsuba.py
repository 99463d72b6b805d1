"""Renders a composition with diorama and with Mitsuba 3, compares the pictures, and times both in turns.

    pip install mitsuba numpy
    python3 benches/peers/path_mitsuba.py scene.toml [--diorama target/release/diorama] [--variants llvm_ad_rgb,scalar_rgb]

The composition is lit by an HDRI or uniform light. Surfaces without reflection (KHR_materials_specular, factor 0) are Lambertian in both
programs and must agree; others become Mitsuba's `principled`, which differs from glTF's material. The LLVM variants need libLLVM
(DRJIT_LIBLLVM_PATH names it). Prints medians of samples per second, the ratio of diorama's to each variant's, PSNR and the ratio of means.
"""
import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time

import mitsuba as mi
import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from exported_scene import Glb, export, psnr, write_ply  # noqa: E402


def texture(glb, folder, info, raw):
    if info is None:
        return None
    path = os.path.join(folder, f"texture{info['index']}.png")
    with open(path, "wb") as f:
        f.write(glb.image(info["index"]))
    return {"type": "bitmap", "filename": path, "raw": raw}


def bsdf(glb, folder, index):
    m = glb.root["materials"][index]
    pbr = m.get("pbrMetallicRoughness", {})
    specular = m.get("extensions", {}).get("KHR_materials_specular", {}).get("specularFactor", 1.0)
    factor = pbr.get("baseColorFactor", [1, 1, 1, 1])[:3]
    color = texture(glb, folder, pbr.get("baseColorTexture"), False)
    if color is None:
        color = {"type": "rgb", "value": factor}
    elif factor != [1, 1, 1]:
        print(f"note: the factor {factor} of a textured material is left out", file=sys.stderr)
    metallic, roughness = pbr.get("metallicFactor", 1.0), pbr.get("roughnessFactor", 1.0)
    if specular == 0 and metallic == 0:
        inner = {"type": "diffuse", "reflectance": color}
    else:
        inner = {"type": "principled", "base_color": color, "metallic": metallic, "roughness": roughness, "specular": 0.5 * specular}
    return {"type": "twosided", "bsdf": inner}


def environment(light, path):
    """Mitsuba's texels lie on the borders of the map; twice the resolution, they give the same function."""
    image = np.array(mi.Bitmap(path).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32))
    h, w = image.shape[:2]

    def blend(v, at, axis, wrap):
        low = np.floor(at).astype(int)
        share = (at - low).reshape([-1 if a == axis else 1 for a in range(3)])
        index = [i % v.shape[axis] if wrap else np.clip(i, 0, v.shape[axis] - 1) for i in (low, low + 1)]
        return np.take(v, index[0], axis) * (1 - share) + np.take(v, index[1], axis) * share

    # Their first column looks along -z, ours along +z.
    image = blend(image, np.arange(2 * w) / 2 - 0.5 + w / 2, 1, True)
    image = blend(image, np.arange(2 * h + 1) / 2 - 0.5, 0, False)
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], np.degrees(light["turn"]))
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    bitmap = mi.Bitmap(np.ascontiguousarray(image, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "scale": light["strength"], "to_world": turn @ upright}


def load(folder, told):
    """The exported folder as a scene of the current variant."""
    glb = Glb(os.path.join(folder, "scene.glb"))
    camera, (width, height) = told["camera"], told["size"]
    flip = np.diag([-1, 1, -1, 1])
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, "pixel_format": "rgb", "component_format": "float32"}
    sensor = {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(18 / camera["lens_mm"]))),
        "principal_point_offset_x": -camera["shift"][0],
        "principal_point_offset_y": camera["shift"][1] * width / height,
        "near_clip": 1e-3,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(np.array(camera["world_from_camera"], float) @ flip),
        "film": film,
        "sampler": {"type": "independent"},
    }
    if camera["f_stop"] is not None:
        radius = camera["lens_mm"] / 2000 / camera["f_stop"]
        sensor |= {"type": "thinlens", "aperture_radius": radius, "focus_distance": camera["focus"]}
    scene = {
        "type": "scene",
        "sensor": sensor,
        "integrator": {"type": "path", "max_depth": told["bounces"] + 1, "rr_depth": 5, "hide_emitters": told["transparent"]},
        "light": environment(told["light"], os.path.join(folder, told["light"]["file"])),
    }
    if told["light"]["sun"]:
        sys.exit("give a composition whose light has no sun of its own: [light] hdri = …")
    for i, (matrix, primitive) in enumerate(glb.placed()):
        attributes = {k: glb.accessor(v) for k, v in primitive["attributes"].items()}
        path = os.path.join(folder, f"mesh{i}.ply")
        faces = glb.accessor(primitive["indices"]).reshape(-1, 3)
        write_ply(path, matrix, attributes["POSITION"], attributes.get("NORMAL"), attributes.get("TEXCOORD_0"), faces)
        scene[f"mesh{i}"] = {"type": "ply", "filename": path, "bsdf": bsdf(glb, folder, primitive["material"])}
    return mi.load_dict(scene)


def picture(scene, samples, per_pass):
    total = 0
    for seed in range(samples // per_pass):
        total = total + np.array(mi.render(scene, spp=per_pass, seed=1000 + seed), dtype=np.float64)
    return total / (samples // per_pass)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scene")
    parser.add_argument("--diorama", default="target/release/diorama")
    parser.add_argument("--variants", default="llvm_ad_rgb,scalar_rgb")
    parser.add_argument("--spp", type=int, default=16, help="samples per pixel of a timed picture")
    parser.add_argument("--match-spp", type=int, default=1024, help="samples per pixel of the compared pictures")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = os.path.join(temporary, "scene")
        told = export(options.diorama, options.scene, folder)
        width, height = told["size"]
        scenes = {}
        for variant in options.variants.split(","):
            try:
                mi.set_variant(variant)
                scenes[variant] = load(folder, told)
                np.array(mi.render(scenes[variant], spp=options.spp, seed=0))
            except Exception as e:  # a variant that does not run here is reported, not fatal
                print(f"{variant}: does not run: {e}")
        speeds = {"diorama": [], **{v: [] for v in scenes}}
        for turn in range(options.repeats):
            command = [options.diorama, "bench", "path-trace", options.scene, "--spp", str(options.spp), "--repeats", "1", "--json"]
            told_speed = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
            speeds["diorama"].append(told_speed["samples_per_s"])
            for variant, scene in scenes.items():
                mi.set_variant(variant)
                start = time.perf_counter()
                np.array(mi.render(scene, spp=options.spp, seed=turn + 1))
                speeds[variant].append(width * height * options.spp / (time.perf_counter() - start))
        ours = statistics.median(speeds["diorama"])
        print(f"{width} x {height}, {options.spp} samples per pixel, medians of {options.repeats} in turns")
        for name, values in speeds.items():
            speed = statistics.median(values)
            print(f"{name:<14} {speed / 1e6:7.2f} M samples/s   diorama is {ours / speed:5.2f} x")
        if not scenes:
            sys.exit(1)
        variant = next(iter(scenes))
        mi.set_variant(variant)
        theirs = picture(scenes[variant], options.match_spp, min(64, options.match_spp))
        out = os.path.join(temporary, "ours.exr")
        command = [options.diorama, "relight", "compose", options.scene, "--spp", str(options.match_spp), "--denoise", "off", "-o", out]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        linear = np.array(mi.Bitmap(out).convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.Float32), dtype=np.float64)
        decibels, ratio = psnr(linear[..., :3], theirs)
        print(f"{variant}: {decibels:.2f} dB at {options.match_spp} samples per pixel, mean x {ratio:.4f}")
        keep = os.environ.get("DIORAMA_KEEP_PICTURES")
        if keep:
            mi.Bitmap(theirs.astype(np.float32)).write(os.path.join(keep, "mitsuba.exr"))
            mi.Bitmap(linear.astype(np.float32)[..., :3]).write(os.path.join(keep, "ours.exr"))


main()
