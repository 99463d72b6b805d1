"""Checks exported meshes with independent readers: Blender (GLB, OBJ, PLY, STL, DAE), usd-core (USDZ),
pycollada (DAE), trimesh (GLB, OBJ, PLY, STL); and point clouds with trimesh (PLY), laspy (LAS), pye57 (E57).

    diorama export RUN -o OUT/m.{glb,obj,ply,stl,usdz,dae} ...
    python3 benches/formats.py OUT/m                          # trimesh, usd-core, pycollada
    python3 benches/formats.py OUT/m OUT/lit.glb OUT/lit.obj  # more files of the same surface, by trimesh
    blender -b -P benches/formats.py -- OUT/m
    diorama export RUN -o OUT/cloud.{ply,las,e57} --format points ...
    python3 benches/formats.py --points OUT/cloud             # trimesh, laspy, pye57

Prints the bounds in meters, z up, that each reader finds, and whether there is a texture or colors; fails where two readers
differ by more than a millimeter, where clouds differ in their points or colors, or where a file whose name begins with "lit" has no
normal map.
"""
import sys

try:
    import bpy
except ImportError:
    bpy = None
import numpy as np

if bpy:
    # Blender 3.4 asks for an alias that numpy dropped in 1.24.
    np.bool = bool
stem, *more = sys.argv[sys.argv.index("--") + 1 :] if bpy else sys.argv[1:]
found = {}


def turned(points):
    """glTF and USD are y up."""
    x, y, z = np.asarray(points, float).T
    return np.stack([x, -z, y], 1)


def note(reader, points, looks):
    points = np.asarray(points, float)
    found[reader] = np.array([points.min(0), points.max(0)])
    print(f"{reader:24} {len(points):8} points  {np.round(found[reader][0], 4)} .. {np.round(found[reader][1], 4)}  {looks}")


if bpy:
    load = {
        "glb": lambda f: bpy.ops.import_scene.gltf(filepath=f),
        "obj": lambda f: bpy.ops.wm.obj_import(filepath=f, forward_axis="Y", up_axis="Z"),
        "ply": lambda f: bpy.ops.import_mesh.ply(filepath=f),
        "stl": lambda f: bpy.ops.import_mesh.stl(filepath=f),
        "dae": lambda f: bpy.ops.wm.collada_import(filepath=f),
    }
    for kind, read in load.items():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        if kind in ("ply", "stl"):
            bpy.ops.preferences.addon_enable(module=f"io_mesh_{kind}")
        read(f"{stem}.{kind}")
        (thing,) = [o for o in bpy.data.objects if o.type == "MESH"]
        pictures = [f'{i.name} {i.size[0]} x {i.size[1]}' for i in bpy.data.images]
        looks = f"images {pictures}, uvs {len(thing.data.uv_layers)}, colors {len(thing.data.color_attributes)}"
        note(f"blender {kind}", [thing.matrix_world @ v.co for v in thing.data.vertices], looks)
elif stem == "--points":
    import laspy
    import pye57
    import trimesh

    (stem,) = more
    cloud = trimesh.load(f"{stem}.ply", process=False)
    assert isinstance(cloud, trimesh.PointCloud) and len(cloud.colors) == len(cloud.vertices), type(cloud)
    las = laspy.read(f"{stem}.las")
    assert las.header.version == "1.2" and {"NormalX", "NormalY", "NormalZ"} <= set(las.point_format.dimension_names)
    scans = pye57.E57(f"{stem}.e57")
    assert scans.scan_count == 1
    scan = scans.read_scan(0, colors=True, ignore_missing_fields=True)
    e57 = np.stack([scan[f"cartesian{a}"] for a in "XYZ"], 1)
    e57_rgb = np.stack([scan[f"color{c}"] for c in ("Red", "Green", "Blue")], 1)
    las_rgb = np.stack([las.red, las.green, las.blue], 1).astype(int) // 257
    clouds = {"trimesh ply": (cloud.vertices, cloud.colors[:, :3]), "laspy las": (las.xyz, las_rgb), "pye57 e57": (e57, e57_rgb)}
    points, colors = clouds["trimesh ply"]
    for name, (p, rgb) in clouds.items():
        note(name, p, f"colors {np.round(rgb.mean(0), 1)}")
        assert p.shape == points.shape and np.abs(p - points).max() < 1e-3, f"{name}: other points"
        assert np.abs(rgb.astype(int) - colors.astype(int)).max() <= 1, f"{name}: other colors"
    lengths = np.linalg.norm(np.stack([las.NormalX, las.NormalY, las.NormalZ], 1), axis=1)
    assert np.abs(lengths - 1).max() < 1e-3, "normals of other lengths"
else:
    import os

    import collada
    import trimesh
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    for kind in ["glb", "obj", "ply", "stl"]:
        m = trimesh.load(f"{stem}.{kind}", force="mesh", process=False)
        note(f"trimesh {kind}", turned(m.vertices) if kind == "glb" else m.vertices, type(m.visual).__name__)
    for file in more:
        m = trimesh.load(file, force="mesh", process=False)
        note(f"trimesh {os.path.basename(file)}", turned(m.vertices) if file.endswith("glb") else m.vertices, type(m.visual).__name__)
        if os.path.basename(file).startswith("lit"):
            material = m.visual.material
            is_lit = material.normalTexture is not None if file.endswith("glb") else {"norm", "map_bump"} <= {k.lower() for k in material.kwargs}
            assert is_lit, f"{file}: no normal map in {material.__dict__}"
    stage = Usd.Stage.Open(f"{stem}.usdz")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Root/Object"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    ok, warnings = UsdGeom.Mesh.ValidateTopology(mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), len(mesh.GetPointsAttr().Get()))
    assert ok, warnings
    registry = UsdValidation.ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(m.name) for m in registry.GetAllValidatorMetadata()]
    complaints = UsdValidation.ValidationContext(validators).Validate(stage)
    assert not complaints, [c.GetMessage() for c in complaints]
    material = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]
    note("usd-core usdz", turned(mesh.GetPointsAttr().Get()), f"material {material.GetPath()}, {len(validators)} validators content")
    scene = collada.Collada(f"{stem}.dae")
    assert scene.assetInfo.unitmeter == 1 and str(scene.assetInfo.upaxis) == "Z_UP" and not scene.errors
    (shape,) = scene.geometries
    note("pycollada dae", shape.primitives[0].vertex, f"images {[i.path for i in scene.images]}")

first = next(iter(found.values()))
worst = max(np.abs(f - first).max() for f in found.values())
print(f"largest difference between readers: {worst * 1000:.3f} mm")
sys.exit(int(worst > 1e-3))
