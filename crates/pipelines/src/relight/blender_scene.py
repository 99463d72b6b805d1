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
import numpy
from mathutils import Matrix, Vector

if "bool" not in vars(numpy):
    # The glTF importer of Blender 3.4 asks for it, and newer versions of NumPy lack it.
    numpy.bool = bool

FOLDER = os.path.dirname(os.path.abspath(__file__))


def is_value(socket, value):
    return not socket.is_linked and abs(socket.default_value - value) < 1e-6


def adapt_material(material, specular):
    """Makes opaque surfaces without metalness those of glTF: a Lambertian one below a reflection.

    Blender's Principled shader is brighter there, because its diffuse part reflects back toward the light.
    """
    tree = material.node_tree
    for node in [n for n in tree.nodes if n.type == "BSDF_PRINCIPLED"]:
        # Keeps the light that is scattered several times between microfacets.
        node.distribution = "MULTI_GGX"
        inputs = node.inputs
        node.inputs["Specular"].default_value = 0.5 * specular
        if not (is_value(inputs["Metallic"], 0) and is_value(inputs["Alpha"], 1) and is_value(inputs["Transmission"], 0)):
            continue
        targets = [link.to_socket for link in node.outputs["BSDF"].links]
        diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
        copy_input(tree, inputs["Base Color"], diffuse.inputs["Color"])
        copy_input(tree, inputs["Normal"], diffuse.inputs["Normal"])
        shader = diffuse if specular == 0 else below_reflection(tree, node, diffuse, specular)
        for target in targets:
            tree.links.new(shader.outputs[0], target)


def copy_input(tree, source, target):
    if source.is_linked:
        tree.links.new(source.links[0].from_socket, target)
    elif source.name != "Normal":
        target.default_value = source.default_value


def below_reflection(tree, principled, diffuse, specular):
    """What the reflection leaves of the diffuse light, and the reflection: Fresnel's share, and one in twenty of the roughest surfaces'."""
    reflected, share = tree.nodes.new("ShaderNodeFresnel"), tree.nodes.new("ShaderNodeMixRGB")
    dimmed, both = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeAddShader")
    reflected.inputs["IOR"].default_value = 1.5
    copy_input(tree, principled.inputs["Normal"], reflected.inputs["Normal"])
    copy_input(tree, principled.inputs["Roughness"], share.inputs["Fac"])
    tree.links.new(reflected.outputs[0], share.inputs["Color1"])
    share.inputs["Color2"].default_value = (0.05, 0.05, 0.05, 1)
    scaled = tree.nodes.new("ShaderNodeMath")
    scaled.operation = "MULTIPLY"
    scaled.inputs[1].default_value = specular
    tree.links.new(share.outputs[0], scaled.inputs[0])
    tree.links.new(scaled.outputs[0], dimmed.inputs[0])
    tree.links.new(diffuse.outputs[0], dimmed.inputs[1])
    color = principled.inputs["Base Color"]
    for link in list(color.links):
        tree.links.remove(link)
    color.default_value = (0, 0, 0, 1)
    tree.links.new(dimmed.outputs[0], both.inputs[0])
    tree.links.new(principled.outputs["BSDF"], both.inputs[1])
    return both


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
    parser.add_argument("--principled", action="store_true", help="leave the materials as Blender imports them")
    options = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])
    with open(os.path.join(FOLDER, "scene.json"), encoding="utf-8") as f:
        told = json.load(f)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=os.path.join(FOLDER, told["model"]))
    if not options.principled:
        for material in bpy.data.materials:
            # Blender's importer reads no KHR_materials_specular that is the same everywhere.
            adapt_material(material, told["specular"].get(material.name, 1.0))
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
