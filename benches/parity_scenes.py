"""Writes two compositions for comparisons with other renderers: diffuse.toml, whose surfaces are Lambertian, and pbr.toml.

    python3 benches/parity_scenes.py OUT --hdri dusk.hdr [--diorama target/release/diorama]
    python3 benches/peers/path_mitsuba.py OUT/diffuse.toml
    python3 benches/blender_parity.py OUT/diffuse.toml
    python3 benches/blender_parity.py OUT/pbr.toml

The object is the generated chair; in diffuse.toml its materials lose their reflection, roughness textures and normal maps.
"""
import argparse
import json
import os
import struct
import subprocess

FLOOR = "v -4 0 -4\nv -4 0 4\nv 4 0 4\nv 4 0 -4\nvt 0 0\nvt 0 1\nvt 1 1\nvt 1 0\nvn 0 1 0\nf 1/1/1 2/2/1 3/3/1 4/4/1\n"
SCENE = """[scene]
mesh = "{floor}"
[[object]]
mesh = "{object}"
rotate_deg = [0, 25, 0]
snap = "ground"
[light]
hdri = "{hdri}"
rotate_deg = 60
[camera]
eye = [1.3, 1.3, 2.1]
target = [0, 0.4, 0]
fov_deg = 45
[render]
size = [640, 360]
spp = 256
bounces = 8
backplate = "none"
"""


def rewrite(source, target, change):
    """Copies a .glb with other JSON."""
    with open(source, "rb") as f:
        data = f.read()
    length = struct.unpack_from("<I", data, 12)[0]
    root = json.loads(data[20 : 20 + length])
    change(root)
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    with open(target, "wb") as f:
        f.write(struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest)


def make_diffuse(root):
    for m in root["materials"]:
        pbr = m.setdefault("pbrMetallicRoughness", {})
        pbr |= {"metallicFactor": 0, "roughnessFactor": 1}
        pbr.pop("metallicRoughnessTexture", None)
        for key in ("normalTexture", "occlusionTexture"):
            m.pop(key, None)
        m["extensions"] = {"KHR_materials_specular": {"specularFactor": 0}}
    root["extensionsUsed"] = sorted({*root.get("extensionsUsed", []), "KHR_materials_specular"})


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("--hdri", required=True)
    parser.add_argument("--diorama", default="target/release/diorama")
    options = parser.parse_args()
    out = options.out
    os.makedirs(out, exist_ok=True)
    with open(os.path.join(out, "floor.obj"), "w", encoding="utf-8") as f:
        f.write(FLOOR)
    generated = os.path.join(out, "generated")
    command = [options.diorama, "relight", "scenario", "synthetic-in-synthetic", "--size", "64x36", "--spp", "1", "-o", generated, "--force"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    # The floor as .glb, through the same writer.
    probe = SCENE.format(floor="floor.obj", object="generated/object.glb", hdri=os.path.abspath(options.hdri))
    with open(os.path.join(out, "pbr.toml"), "w", encoding="utf-8") as f:
        f.write(probe)
    export = [options.diorama, "relight", "compose", os.path.join(out, "pbr.toml"), "--spp", "1", "-o", os.path.join(out, "probe.exr"), "--force"]
    subprocess.run([*export, "--export-blender", os.path.join(out, "exported")], check=True, stdout=subprocess.DEVNULL)
    rewrite(os.path.join(out, "exported", "scene.glb"), os.path.join(out, "diffuse.glb"), make_diffuse)
    whole = "[scene]\nmesh = \"diffuse.glb\"\n" + probe[probe.index("[light]") :]
    with open(os.path.join(out, "diffuse.toml"), "w", encoding="utf-8") as f:
        f.write(whole)


main()
