#!/usr/bin/env bash
# Installs the independent readers with which crates/cli/tests/readers.rs opens exported meshes, into FOLDER (DIORAMA_READERS, or target/readers):
# trimesh, pycollada, usd-core, laspy, pye57 and ONNX Runtime in a virtual environment, Khronos's glTF validator for Node.js; and ffmpeg 9 as
# FOLDER/ffmpeg (DIORAMA_NEW_FFMPEG), because the machine's own may lack recent options.
#
#     benches/readers.sh target/readers
set -euo pipefail
folder="${1:?usage: benches/readers.sh FOLDER}"
mkdir -p "$folder"
[ -x "$folder/venv/bin/python" ] || python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check numpy trimesh==5.2.0 pycollada==0.9.3 usd-core==26.11 \
    laspy==2.7.0 pye57==0.4.19 pillow==13.0.0 imageio-ffmpeg==0.8.1 onnxruntime==1.32.0
npm install --prefix "$folder" --ignore-scripts --no-audit --no-fund --silent gltf-validator@2.0.0-dev.3.10
ln -sfn "$("$folder/venv/bin/python" -c 'import imageio_ffmpeg; print(imageio_ffmpeg.get_ffmpeg_exe())')" "$folder/ffmpeg"
