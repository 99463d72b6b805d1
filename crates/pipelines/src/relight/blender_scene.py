"""Opens an exported composition in Blender: model, world light, sun, camera and render settings.

    blender -P scene.py                                  to work on it
    blender -b -P scene.py -- --render picture.exr       to render it with Cycles
    blender -b -P scene.py -- --render picture.exr --samples 256

Colors are shown by the Standard view; an .exr holds linear light.
"""
import argparse
import json
import math
import os
import sys

import bpy
from mathutils import Matrix, Vector

FOLDER = os.path.dirname(os.path.abspath(__file__))


def is_value(socket, value):
    return not socket.is_linked and abs(socket.default_value - value) < 1e-6


def adapt_material(material):
    """Keeps the light that is scattered several times between microfacets; surfaces without any reflection become Lambertian."""
    tree = material.node_tree
    if tree is None:
        return
    for node in [n for n in tree.nodes if n.type == "BSDF_PRINCIPLED"]:
        node.distribution = "MULTI_GGX"
        if not (is_value(node.inputs["Specular"], 0) and is_value(node.inputs["Metallic"], 0)):
            continue
        diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
        for name in ("Color", "Normal"):
            source = node.inputs["Base Color" if name == "Color" else name]
            if source.is_linked:
                tree.links.new(source.links[0].from_socket, diffuse.inputs[name])
            elif name == "Color":
                diffuse.inputs[name].default_value = source.default_value
        for link in list(node.outputs["BSDF"].links):
            tree.links.new(diffuse.outputs["BSDF"], link.to_socket)


def add_world(scene, light):
    world = bpy.data.worlds.new("light")
    scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    place, turn = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    image, background, output = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    # The center of the map is +y; Blender has +x there.
    turn.inputs["Rotation"].default_value = (0, 0, -(math.pi / 2 + light["turn"]))
    image.image = bpy.data.images.load(os.path.join(FOLDER, light["file"]))
    background.inputs["Strength"].default_value = light["strength"]
    links.new(place.outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs["Vector"], image.inputs["Vector"])
    links.new(image.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs["Background"], output.inputs["Surface"])


def add_sun(scene, sun):
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.angle = sun["diameter"]
    lamp.energy = max(sun["irradiance"])
    lamp.color = [v / lamp.energy for v in sun["irradiance"]]
    lamp.cycles.max_bounces = 1024
    stand = bpy.data.objects.new("sun", lamp)
    # Lamps shine along their -z axis.
    stand.rotation_mode = "QUATERNION"
    stand.rotation_quaternion = Vector(sun["direction"]).to_track_quat("Z", "Y")
    scene.collection.objects.link(stand)


def add_camera(scene, camera, size):
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = 36.0
    data.lens = camera["lens_mm"]
    data.shift_x, data.shift_y = camera["shift"]
    data.clip_start, data.clip_end = 1e-3, 1e5
    if camera["f_stop"] is not None:
        data.dof.use_dof = True
        data.dof.aperture_fstop = camera["f_stop"]
        data.dof.focus_distance = camera["focus"]
    stand = bpy.data.objects.new("camera", data)
    stand.matrix_world = Matrix(camera["world_from_camera"])
    scene.collection.objects.link(stand)
    scene.camera = stand
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    aspect = camera["pixel_aspect"]
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(aspect, 1.0), max(1.0 / aspect, 1.0)


def set_up_rendering(scene, told):
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = told["spp"]
    cycles.seed = told["seed"]
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.pixel_filter_type = "BOX"
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = 0.0
    # Blender counts bounces after direct light.
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = told["bounces"] - 1
    cycles.transparent_max_bounces = 64
    scene.render.film_transparent = told["transparent"]
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure = told["exposure"]
    scene.view_settings.gamma = 1.0


def render(scene, path):
    image = scene.render.image_settings
    if path.lower().endswith(".exr"):
        image.file_format, image.color_depth = "OPEN_EXR", "32"
    else:
        image.file_format, image.color_depth = "PNG", "8"
    image.color_mode = "RGBA"
    scene.render.filepath = os.path.abspath(path)
    bpy.ops.render.render(write_still=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--render", metavar="PICTURE", help=".exr or .png")
    parser.add_argument("--samples", type=int, help="samples per pixel")
    options = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])
    with open(os.path.join(FOLDER, "scene.json"), encoding="utf-8") as f:
        told = json.load(f)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=os.path.join(FOLDER, told["model"]))
    for material in bpy.data.materials:
        adapt_material(material)
    scene = bpy.context.scene
    add_world(scene, told["light"])
    if told["light"]["sun"]:
        add_sun(scene, told["light"]["sun"])
    add_camera(scene, told["camera"], told["size"])
    set_up_rendering(scene, told)
    if options.samples:
        scene.cycles.samples = options.samples
    if options.render:
        render(scene, options.render)


main()
