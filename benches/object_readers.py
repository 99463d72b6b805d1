"""Draws a GLB of `diorama relight object` with Blender, three.js in Chromium and trimesh, and compares the pictures with diorama's.

    pip install numpy pillow trimesh
    npm install three puppeteer-core gltf-validator --prefix FOLDER
    python3 benches/object_readers.py object.glb --node FOLDER [--chromium chromium] [--blender blender] [--diorama target/release/diorama]

Lit pictures share one environment. Each is also compared after the base color, the roughness or the normals were mirrored in the GLB, which must cost
decibels: that shows the comparison would notice. trimesh draws base color alone, which is compared with three.js's.
"""
import argparse
import base64
import io
import json
import os
import struct
import subprocess
import tempfile

import numpy as np
import trimesh
from PIL import Image

SIZE = 256
FOV = 40.0

PAGE = """<script type="importmap">{"imports": {"three": "./three/build/three.module.js", "three/addons/": "./three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from 'three';
import {GLTFLoader} from 'three/addons/loaders/GLTFLoader.js';
const renderer = new THREE.WebGLRenderer({antialias: true, alpha: true, preserveDrawingBuffer: true});
renderer.setSize(SIZE, SIZE); renderer.toneMapping = THREE.NoToneMapping; renderer.setClearColor(0, 0);
window.draw = async (glb, light, width, eye, target, fov, lit) => {
  const bytes = s => Uint8Array.from(atob(s), c => c.charCodeAt(0));
  const gltf = await new GLTFLoader().parseAsync(bytes(glb).buffer, '');
  const scene = new THREE.Scene(); scene.add(gltf.scene);
  const map = new THREE.DataTexture(new Float32Array(bytes(light).buffer), width, width / 2, THREE.RGBAFormat, THREE.FloatType);
  map.mapping = THREE.EquirectangularReflectionMapping; map.minFilter = map.magFilter = THREE.LinearFilter; map.needsUpdate = true;
  scene.environment = new THREE.PMREMGenerator(renderer).fromEquirectangular(map).texture;
  gltf.scene.traverse(m => { if (m.isMesh && !lit) m.material = new THREE.MeshBasicMaterial({map: m.material.map}); });
  const camera = new THREE.PerspectiveCamera(fov, 1, 0.01, 100);
  camera.position.set(...eye); camera.lookAt(...target); renderer.render(scene, camera);
  return renderer.domElement.toDataURL().split(',')[1];
};
window.ready = true;
</script>""".replace("SIZE", str(SIZE))

DRIVER = """const puppeteer = require('puppeteer-core'), http = require('http'), fs = require('fs'), path = require('path');
const job = JSON.parse(fs.readFileSync(process.argv[2]));
const types = {'.js': 'text/javascript', '.html': 'text/html'};
const server = http.createServer((q, r) => {
  if (q.url === '/') { r.setHeader('Content-Type', 'text/html'); return r.end(job.page); }
  const file = path.join(job.modules, q.url);
  if (!fs.existsSync(file)) { r.statusCode = 404; return r.end(); }
  r.setHeader('Content-Type', types[path.extname(file)] || 'application/octet-stream'); r.end(fs.readFileSync(file));
}).listen(0, async () => {
  const args = ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'];
  const browser = await puppeteer.launch({executablePath: job.chromium, headless: true, args, protocolTimeout: 300000});
  const page = await browser.newPage();
  page.on('pageerror', e => console.error(String(e)));
  await page.goto('http://localhost:' + server.address().port + '/');
  await page.waitForFunction('window.ready', {timeout: 60000});
  for (const d of job.drawings) fs.writeFileSync(d.out, Buffer.from(await page.evaluate((...a) => window.draw(...a), ...d.args), 'base64'));
  await browser.close(); server.close();
});
"""


def parts(glb):
    """JSON and binary chunk of a GLB."""
    length, = struct.unpack_from("<I", glb, 12)
    return json.loads(glb[20:20 + length]), glb[28 + length:]


def with_image(glb, index, change):
    """The GLB with one of its images changed."""
    scene, binary = parts(glb)
    view = scene["bufferViews"][scene["images"][index]["bufferView"]]
    first = view.get("byteOffset", 0)
    image = change(Image.open(io.BytesIO(binary[first:first + view["byteLength"]])).convert("RGB"))
    out = io.BytesIO()
    image.save(out, "PNG")
    binary += b"\0" * (-len(binary) % 4)
    view["byteOffset"], view["byteLength"] = len(binary), len(out.getvalue())
    scene["images"][index]["mimeType"] = "image/png"
    binary += out.getvalue()
    binary += b"\0" * (-len(binary) % 4)
    scene["buffers"][0]["byteLength"] = len(binary)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<III", 0x46546C67, 2, 28 + len(text) + len(binary))
    return head + struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary


def light():
    """A sky, a warm lamp at +x and a cold one at -z, low; [H, W, 3], u = 1/2 + atan2(x, -z) / 2 pi."""
    h, w = 64, 128
    v, u = np.mgrid[0:h, 0:w]
    polar, around = np.pi * (v + 0.5) / h, 2 * np.pi * ((u + 0.5) / w - 0.5)
    d = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), -np.sin(polar) * np.cos(around)], -1)
    lobe = lambda at, sharp: np.exp(sharp * (d @ (np.array(at) / np.linalg.norm(at)) - 1))[..., None]
    return 0.15 + lobe([1, 0.5, 0.2], 8) * [6, 4, 2] + lobe([-0.3, 0.4, -1], 12) * [1, 2, 5] + lobe([-0.5, -0.4, 1], 6) * [0.5, 1.5, 0.7]


def save_hdr(path, image):
    largest = image.max(-1)
    mantissa, exponent = np.frexp(largest)
    rgbe = np.concatenate([image * (mantissa * 256 / largest)[..., None], (exponent + 128)[..., None]], -1).astype(np.uint8)
    with open(path, "wb") as f:
        f.write(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % image.shape[:2] + rgbe.tobytes())


def picture(path):
    """[H, W, 3] from 0 to 1 before white."""
    image = np.asarray(Image.open(path).convert("RGBA"), dtype=float) / 255
    return image[..., :3] * image[..., 3:] + 1 - image[..., 3:]


def psnr(a, b):
    return -10 * np.log10(((a - b) ** 2).mean())


def base_color(mesh, eye, target):
    """Base color of trimesh's mesh [H, W, 3] before white, point by point with a depth buffer."""
    n = 400_000
    points, faces = trimesh.sample.sample_surface(mesh, n, seed=0)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
    uv = (mesh.visual.uv[mesh.faces[faces]] * weights[..., None]).sum(1)
    colors = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"), dtype=float) / 255
    h, w = colors.shape[:2]
    # trimesh turns v upward.
    values = colors[((1 - uv[:, 1]) * h).astype(int).clip(0, h - 1), (uv[:, 0] * w).astype(int).clip(0, w - 1)]
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    p = (points - eye) @ np.stack([right, np.cross(back, right), back], 1)
    scale = 0.5 * SIZE / np.tan(np.radians(FOV / 2))
    x, y = (0.5 * SIZE + scale * p[:, 0] / -p[:, 2]).astype(int), (0.5 * SIZE - scale * p[:, 1] / -p[:, 2]).astype(int)
    out = np.ones((SIZE, SIZE, 3))
    order = np.argsort(p[:, 2])
    inside = ((x >= 0) & (y >= 0) & (x < SIZE) & (y < SIZE))[order]
    out[y[order][inside], x[order][inside]] = values[order][inside]
    return out


def compose(o, folder, name, glb, eye, target):
    """diorama's picture, and with `blend` the folder for Blender."""
    model, toml = os.path.join(folder, name + ".glb"), os.path.join(folder, name + ".toml")
    open(model, "wb").write(glb)
    open(toml, "w").write(f"""[scene]
mesh = "{name}.glb"
[light]
hdri = "light.hdr"
[camera]
eye = {eye.tolist()}
target = {target.tolist()}
fov_deg = {FOV}
[render]
size = [{SIZE}, {SIZE}]
spp = {o.spp}
denoise = "off"
backplate = "none"
exposure = 0
""")
    out, blend = os.path.join(folder, name + ".png"), os.path.join(folder, name + ".blend")
    quiet = {"check": True, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.run([o.diorama, "relight", "compose", toml, "--export-blender", blend, "--force", "-o", out], **quiet)
    return out, blend


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("glb")
    parser.add_argument("--node", required=True, help="folder of node_modules")
    parser.add_argument("--diorama", default="target/release/diorama")
    parser.add_argument("--blender", default="blender")
    parser.add_argument("--chromium", default="chromium")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--keep", metavar="DIR", help="where pictures go")
    o = parser.parse_args()
    glb = open(o.glb, "rb").read()
    mesh = trimesh.load(o.glb, force="mesh")
    low, high = mesh.bounds
    target = 0.5 * (low + high)
    eye = target + 1.5 * np.linalg.norm(high - low) * np.array([0.55, 0.4, 0.73])
    scene, _ = parts(glb)
    material = scene["materials"][0]
    of = lambda t: scene["textures"][t["index"]]["source"]
    pbr = material["pbrMetallicRoughness"]
    mirror = lambda im: im.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    green = lambda im: Image.merge("RGB", [im.split()[0], im.split()[1].point(lambda v: 255 - v), im.split()[2]])
    variants = {
        "as it is": glb,
        "base color mirrored": with_image(glb, of(pbr["baseColorTexture"]), mirror),
        "roughness mirrored": with_image(glb, of(pbr["metallicRoughnessTexture"]), mirror),
        "normals with green upside down": with_image(glb, of(material["normalTexture"]), green),
    }
    with tempfile.TemporaryDirectory() as temporary:
        folder = os.path.abspath(o.keep or temporary)
        os.makedirs(folder, exist_ok=True)
        environment = light()
        save_hdr(os.path.join(folder, "light.hdr"), environment)
        ours_file, blend = compose(o, folder, "ours", glb, eye, target)
        ours = picture(ours_file)
        # three.js has -z at a quarter of the map.
        turned = np.roll(environment, -environment.shape[1] // 4, 1)[::-1]
        rgba = np.concatenate([turned, np.ones_like(turned[..., :1])], -1).astype("<f4")
        encode = lambda b: base64.b64encode(b).decode()
        args = lambda g, lit: [encode(g), encode(rgba.tobytes()), rgba.shape[1], eye.tolist(), target.tolist(), FOV, lit]
        names = list(variants)
        drawings = [{"out": os.path.join(folder, f"three{i}.png"), "args": args(variants[n], True)} for i, n in enumerate(names)]
        drawings.append({"out": os.path.join(folder, "three_base.png"), "args": args(glb, False)})
        modules = os.path.abspath(os.path.join(o.node, "node_modules"))
        job, driver = os.path.join(folder, "job.json"), os.path.join(folder, "driver.js")
        json.dump({"page": PAGE, "modules": modules, "chromium": o.chromium, "drawings": drawings}, open(job, "w"))
        open(driver, "w").write(DRIVER)
        subprocess.run(["node", driver, job], check=True, env={**os.environ, "NODE_PATH": modules})
        for i, name in enumerate(names):
            open(os.path.join(blend, "scene.glb"), "wb").write(variants[name])
            out = os.path.join(folder, f"blender{i}.png")
            subprocess.run([o.blender, "-b", "--python-exit-code", "1", "-P", os.path.join(blend, "scene.py"), "--", "--render", out,
                            "--samples", str(o.spp)], check=True, stdout=subprocess.DEVNULL)
            print(f"{name}: Blender {psnr(ours, picture(out)):.2f} dB, three.js {psnr(ours, picture(drawings[i]['out'])):.2f} dB")
        exact = picture(os.path.join(folder, "three_base.png"))
        drawn = base_color(mesh, eye, target)
        print(f"base color: trimesh against three.js {psnr(exact, drawn):.2f} dB, mirrored {psnr(exact, drawn[:, ::-1]):.2f} dB")


main()
