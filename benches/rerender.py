"""Renders a textured GLB from held-out cameras in Blender and scores it against the photographs.

    blender -b -P benches/rerender.py -- MESH.glb TRANSFORMS.json OUT [--every 8] [--width W]

Without --every all frames are scored (the Blender set's transforms_test.json); with it every N-th frame
whose image exists. Lens distortion is applied to the coordinates of the render. Needs Debian's blender.
"""
import json
import math
import os
import sys

import bpy
import mathutils
import numpy as np

# Blender 3.4 asks for an alias that numpy dropped in 1.24.
np.bool = bool

arguments = sys.argv[sys.argv.index("--") + 1 :]
mesh, transforms, out = arguments[:3]
option = lambda name, default: int(arguments[arguments.index(name) + 1]) if name in arguments else default
every, width = option("--every", 1), option("--width", 0)
root = os.path.dirname(os.path.abspath(transforms))
os.makedirs(out, exist_ok=True)


def image_of(path):
    for end in ["", ".png", ".jpg"]:
        if os.path.isfile(os.path.join(root, path) + end):
            return os.path.join(root, path) + end


def read(path):
    """[H, W, 4] sRGB, top row first."""
    im = bpy.data.images.load(path)
    im.colorspace_settings.name = "Non-Color"
    im.alpha_mode = "CHANNEL_PACKED"
    w, h = im.size
    px = np.array(im.pixels[:], np.float32).reshape(h, w, -1)[::-1]
    bpy.data.images.remove(im)
    if px.shape[2] == 3:
        px = np.concatenate([px, np.ones_like(px[..., :1])], 2)
    return px


def shrunk(px, w, h):
    """Area mean over whole blocks."""
    by = px.shape[1] // w
    return px[: h * by, : w * by].reshape(h, by, w, by, -1).mean((1, 3))


bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=mesh)
scene = bpy.context.scene
scene.render.engine = "CYCLES"
scene.cycles.device = "CPU"
scene.cycles.samples = 16
scene.cycles.use_denoising = False
scene.cycles.pixel_filter_type = "BOX"
scene.cycles.max_bounces = 0
scene.cycles.transparent_max_bounces = 64
scene.render.film_transparent = True
scene.view_settings.view_transform = "Standard"
scene.render.image_settings.file_format = "PNG"
scene.render.image_settings.color_mode = "RGBA"
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
scene.camera = camera
camera.data.sensor_fit = "HORIZONTAL"
camera.data.clip_end = 1e4

description = json.load(open(transforms))
frames = [f for f in description["frames"] if image_of(f["file_path"])][::every]
scores = []
for i, f in enumerate(frames):
    value = lambda key, default=None: f.get(key, description.get(key, default))
    photo = read(image_of(f["file_path"]))
    h, w = photo.shape[:2]
    fx = value("fl_x") or 0.5 * w / math.tan(0.5 * value("camera_angle_x"))
    fy, cx, cy = value("fl_y", fx), value("cx", 0.5 * w), value("cy", 0.5 * h)
    small = w if not width else width
    by = w // small
    w, h, fx, fy, cx, cy = w // by, h // by, fx / by, fy / by, cx / by, cy / by
    photo = shrunk(photo, w, h)
    # A pinhole wide enough for the distorted corners, resampled below.
    grow = 1.2 if value("k1", 0) else 1.0
    scene.render.resolution_x, scene.render.resolution_y = int(w * grow), int(h * grow)
    scene.render.pixel_aspect_y = fx / fy if fx > fy else 1.0
    scene.render.pixel_aspect_x = fy / fx if fy > fx else 1.0
    camera.data.angle = 2 * math.atan(0.5 * int(w * grow) / fx)
    camera.matrix_world = mathutils.Matrix(f["transform_matrix"])
    scene.render.filepath = os.path.join(os.path.abspath(out), f"{i:03}.png")
    bpy.ops.render.render(write_still=True)
    made = read(scene.render.filepath)
    if grow > 1:
        k1, k2, p1, p2 = (value(k, 0) for k in ["k1", "k2", "p1", "p2"])
        xd, yd = np.meshgrid((np.arange(w) + 0.5 - cx) / fx, (np.arange(h) + 0.5 - cy) / fy)
        x, y = xd.copy(), yd.copy()
        for _ in range(20):
            r2 = x * x + y * y
            d = 1 + r2 * (k1 + r2 * k2)
            x = (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / d
            y = (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / d
        H, W = made.shape[:2]
        u, v = x * fx + 0.5 * W - 0.5, y * fy + 0.5 * H - 0.5
        u0, v0 = np.clip(np.floor(u).astype(int), 0, W - 2), np.clip(np.floor(v).astype(int), 0, H - 2)
        a, b = np.clip(u - u0, 0, 1)[..., None], np.clip(v - v0, 0, 1)[..., None]
        made = (made[v0, u0] * (1 - a) + made[v0, u0 + 1] * a) * (1 - b) + (made[v0 + 1, u0] * (1 - a) + made[v0 + 1, u0 + 1] * a) * b
    white = lambda p: p[..., :3] * p[..., 3:] + 1 - p[..., 3:]
    error = (white(made) - white(photo)) ** 2
    covered = made[..., 3] > 0.99
    psnr = -10 * math.log10(error.mean())
    on_mesh = -10 * math.log10(error[covered].mean()) if covered.any() else float("nan")
    scores.append((psnr, on_mesh))
    print(f"{f['file_path']}: {psnr:.2f} dB, {on_mesh:.2f} dB where the mesh is ({covered.mean() * 100:.0f} %)")
    both = np.concatenate([white(photo), white(made)], 1)[::-1]
    sheet = bpy.data.images.new("sheet", both.shape[1], both.shape[0])
    sheet.colorspace_settings.name = "Non-Color"
    sheet.pixels = np.concatenate([both, np.ones_like(both[..., :1])], 2).ravel().tolist()
    sheet.filepath_raw = os.path.join(os.path.abspath(out), f"both_{i:03}.png")
    sheet.file_format = "PNG"
    sheet.save()
print(f"mean of {len(scores)} views: {np.mean([s[0] for s in scores]):.2f} dB, {np.mean([s[1] for s in scores]):.2f} dB where the mesh is")
