"""Draws GLBs of diorama with Blender, three.js in Chromium and trimesh, and compares the pictures with diorama's.

    pip install numpy pillow trimesh
    npm install three puppeteer-core --prefix FOLDER
    python3 benches/object_readers.py --node FOLDER [object.glb] [--chromium chromium] [--blender blender] [--diorama target/release/diorama]

Lit pictures share one environment. Three plates have a map of four different quarters each: base color, roughness, normals. Their GLBs are written by
`diorama relight compose --export-blender`. Each is also compared after its map was mirrored, turned upside down, or an axis of its normals was reversed,
which must cost at least five decibels: that shows the comparison would notice. trimesh draws base color alone, which is compared with three.js's.
A GLB of `diorama relight object` is compared with its own maps mirrored in the same way; its maps are finer, so that this costs less.
The exit status is 1 if a plate is read wrong, or if a wrong plate costs too little.
"""
import argparse
import base64
import io
import json
import os
import shutil
import struct
import subprocess
import tempfile

import numpy as np
import trimesh
from PIL import Image

SIZE = 256
FOV = 40.0
# Decibels that a wrong map must cost at least, and that a plate must come to.
COST = 5.0
ENOUGH = 32.0

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


def packed(scene, binary):
    """A GLB of JSON and binary chunk."""
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<III", 0x46546C67, 2, 28 + len(text) + len(binary))
    return head + struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary


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
    return packed(scene, binary)


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


def plate(maps):
    """GLB of a curved plate before +z, u to the right and v down; `maps`: of "color", "roughness", "normal", the one that has four quarters."""
    n = 48
    b, a = np.meshgrid(np.linspace(1, -1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    position = np.stack([a, b, 0.25 * (2 - a * a - b * b)], -1).reshape(-1, 3)
    normal = np.stack([0.5 * a, 0.5 * b, np.ones_like(a)], -1).reshape(-1, 3)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    uv = np.stack([(a + 1) / 2, (1 - b) / 2], -1).reshape(-1, 2)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([[corner, corner + n + 1, corner + 1], [corner + 1, corner + n + 1, corner + n + 2]], 1).T
    quarters = lambda values: np.repeat(np.repeat(np.array(values, dtype=np.uint8).reshape(2, 2, 3), 128, 0), 128, 1)
    images = {
        "color": quarters([[220, 40, 30], [60, 180, 60], [40, 60, 210], [230, 210, 90]]),
        "roughness": quarters([[0, 26, 255], [0, 140, 255], [0, 250, 255], [0, 64, 255]]),
        # Tilted by 14 degrees: reflections that point into the plate are black in path tracers, and not in three.js.
        "normal": quarters([[159, 128, 251], [128, 159, 251], [128, 97, 251], [97, 128, 251]]),
    }
    pbr = {"metallicFactor": 0.0 if maps == "color" else 1.0, "roughnessFactor": {"color": 1.0, "roughness": 1.0, "normal": 0.3}[maps]}
    material = {"name": maps, "pbrMetallicRoughness": pbr, **({"normalTexture": {"index": 0}} if maps == "normal" else {})}
    if maps != "normal":
        pbr[{"color": "baseColorTexture", "roughness": "metallicRoughnessTexture"}[maps]] = {"index": 0}
    png = io.BytesIO()
    Image.fromarray(images[maps]).save(png, "PNG")
    chunks = [v.astype("<f4").tobytes() for v in (position, normal, uv)] + [faces.astype("<u4").tobytes(), png.getvalue()]
    views, binary = [], b""
    for c in chunks:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(c)})
        binary += c + b"\0" * (-len(c) % 4)
    bounds = {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
    accessor = lambda view, kind, **more: {"bufferView": view, "componentType": 5126, "count": len(position), "type": kind, **more}
    return packed({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3, "material": 0}]}],
        "accessors": [accessor(0, "VEC3", **bounds), accessor(1, "VEC3"), accessor(2, "VEC2"),
                      {"bufferView": 3, "componentType": 5125, "count": faces.size, "type": "SCALAR"}],
        "materials": [material], "textures": [{"source": 0}], "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "bufferViews": views, "buffers": [{"byteLength": len(binary)}],
    }, binary)


mirror = lambda im: im.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
upside_down = lambda im: im.transpose(Image.Transpose.FLIP_TOP_BOTTOM)


def reversed_channel(k):
    return lambda im: Image.merge("RGB", [c.point(lambda v: 255 - v) if i == k else c for i, c in enumerate(im.split())])


def wrong(glb, kind):
    """GLBs whose map of a kind is wrong, by what is wrong."""
    scene, _ = parts(glb)
    material = scene["materials"][0]
    pbr = material["pbrMetallicRoughness"]
    texture = {"color": pbr.get("baseColorTexture"), "roughness": pbr.get("metallicRoughnessTexture"), "normal": material.get("normalTexture")}[kind]
    changes = {f"{kind} mirrored": mirror, f"{kind} upside down": upside_down}
    if kind == "normal":
        changes.update({"red of normals reversed": reversed_channel(0), "green of normals reversed": reversed_channel(1)})
    source = scene["textures"][texture["index"]]["source"]
    return {name: with_image(glb, source, change) for name, change in changes.items()}


class Readers:
    """Programs that draw a GLB, and where pictures go."""

    def __init__(self, options, folder):
        self.o, self.folder, self.environment = options, folder, light()
        save_hdr(os.path.join(folder, "light.hdr"), self.environment)
        self.modules = os.path.abspath(os.path.join(options.node, "node_modules"))

    def three(self, name, glbs, eye, target, lit=True):
        """three.js's pictures."""
        # three.js has -z at a quarter of the map.
        turned = np.roll(self.environment, -self.environment.shape[1] // 4, 1)[::-1]
        rgba = np.concatenate([turned, np.ones_like(turned[..., :1])], -1).astype("<f4")
        encode = lambda b: base64.b64encode(b).decode()
        files = [os.path.join(self.folder, f"{name}_three{i}{'' if lit else '_base'}.png") for i in range(len(glbs))]
        args = lambda g: [encode(g), encode(rgba.tobytes()), rgba.shape[1], eye.tolist(), target.tolist(), FOV, lit]
        drawings = [{"out": f, "args": args(g)} for f, g in zip(files, glbs)]
        job, driver = os.path.join(self.folder, "job.json"), os.path.join(self.folder, "driver.js")
        json.dump({"page": PAGE, "modules": self.modules, "chromium": shutil.which(self.o.chromium) or self.o.chromium, "drawings": drawings}, open(job, "w"))
        open(driver, "w").write(DRIVER)
        subprocess.run(["node", driver, job], check=True, env={**os.environ, "NODE_PATH": self.modules})
        return [picture(f) for f in files]

    def blender(self, name, glbs, blend):
        """Pictures of Cycles, with the camera and the light of an exported folder."""
        pictures = []
        for i, glb in enumerate(glbs):
            open(os.path.join(blend, "scene.glb"), "wb").write(glb)
            out = os.path.join(self.folder, f"{name}_blender{i}.png")
            subprocess.run([self.o.blender, "-b", "--python-exit-code", "1", "-P", os.path.join(blend, "scene.py"), "--", "--render", out,
                            "--samples", str(self.o.spp)], check=True, stdout=subprocess.DEVNULL)
            pictures.append(picture(out))
        return pictures

    def compare(self, name, glb, eye, target, variants, is_exported):
        """Prints how close both programs come, as it is and with wrong maps; returns the figures, as it is first."""
        ours, blend = compose(self.o, self.folder, name, glb, eye, target)
        if is_exported:
            glb = open(os.path.join(blend, "scene.glb"), "rb").read()
        named = {f"{name} as it is": glb, **variants(glb)}
        drawn = zip(named, self.blender(name, named.values(), blend), self.three(name, list(named.values()), eye, target))
        figures = []
        for title, cycles, browser in drawn:
            figures.append([psnr(picture(ours), cycles), psnr(picture(ours), browser)])
            print(f"{title}: Blender {figures[-1][0]:.2f} dB, three.js {figures[-1][1]:.2f} dB", flush=True)
        return glb, figures

    def base(self, name, glb, eye, target):
        """Prints how close trimesh's base color comes to three.js's, and to it mirrored and upside down."""
        file = os.path.join(self.folder, name + "_trimesh.glb")
        open(file, "wb").write(glb)
        exact = self.three(name, [glb], eye, target, lit=False)[0]
        drawn = base_color(trimesh.load(file, force="mesh"), eye, target)
        figures = [psnr(exact, v) for v in (drawn, drawn[:, ::-1], drawn[::-1])]
        print(f"{name}: trimesh's base color against three.js {figures[0]:.2f} dB, mirrored {figures[1]:.2f} dB, upside down {figures[2]:.2f} dB")
        return figures


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("glb", nargs="?")
    parser.add_argument("--node", required=True, help="folder of node_modules")
    parser.add_argument("--diorama", default="target/release/diorama")
    parser.add_argument("--blender", default="blender")
    parser.add_argument("--chromium", default="chromium")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--keep", metavar="DIR", help="where pictures go")
    o = parser.parse_args()
    faults = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = os.path.abspath(o.keep or temporary)
        os.makedirs(folder, exist_ok=True)
        readers = Readers(o, folder)
        eye, target = np.array([0.5, 0.4, 4.6]), np.array([0.0, 0.0, 0.4])
        for kind in ("color", "roughness", "normal"):
            glb, figures = readers.compare(kind, plate(kind), eye, target, lambda g: wrong(g, kind), True)
            faults += [f"{kind}: {f[i]:.2f} dB, only {figures[0][i] - f[i]:.2f} dB less" for f in figures[1:] for i in (0, 1) if f[i] > figures[0][i] - COST]
            faults += [f"{kind}: {v:.2f} dB" for v in figures[0] if v < ENOUGH]
            if kind == "color":
                figures = readers.base("color", glb, eye, target)
                faults += ["trimesh: base color"] if max(figures[1:]) > figures[0] - COST else []
        if o.glb:
            glb, mesh = open(o.glb, "rb").read(), trimesh.load(o.glb, force="mesh")
            low, high = mesh.bounds
            target = 0.5 * (low + high)
            eye = target + 1.5 * np.linalg.norm(high - low) * np.array([0.55, 0.4, 0.73])
            every = lambda g: {k: v for kind in ("color", "roughness", "normal") for k, v in wrong(g, kind).items()}
            readers.compare("object", glb, eye, target, every, False)
            readers.base("object", glb, eye, target)
    print("\n".join(faults) or "every plate is read right")
    raise SystemExit(1 if faults else 0)


main()
