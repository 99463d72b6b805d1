"""Extracts, shades and writes a surface with scikit-image and trimesh, for comparison with `diorama bench mesh`.

    diorama bench mesh RUN --resolution 512 --save-grid GRID.npy
    python3 benches/peers/mesh_skimage.py GRID.npy LEVEL [REPEATS]

Prints vertices, faces, the median time, and the peak memory above the grid.
"""
import os
import sys
import tempfile
import threading
import time

import numpy as np
import trimesh
from skimage import measure

grid, level = np.load(sys.argv[1]), float(sys.argv[2])
repeats = int(sys.argv[3]) if len(sys.argv) > 3 else 5


def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096


base, peak, stop = resident(), 0, False


def watch():
    global peak
    while not stop:
        peak = max(peak, resident())
        time.sleep(0.01)


watcher = threading.Thread(target=watch)
watcher.start()
times = []
with tempfile.TemporaryDirectory() as folder:
    for _ in range(repeats):
        begin = time.time()
        vertices, faces, normals, _ = measure.marching_cubes(grid, level)
        trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False).export(os.path.join(folder, "m.ply"))
        times.append(time.time() - begin)
stop = True
watcher.join()
print(f"{len(vertices)} vertices, {len(faces)} faces, {sorted(times)[len(times) // 2]:.2f} s, {(peak - base) / 1e6:.0f} MB above the grid")
