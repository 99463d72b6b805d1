#!/usr/bin/env bash
# Installs PaddleOCR's and MMOCR's loaders, with which crates/data/tests/text_loaders.rs reads data sets of writing, into FOLDER
# (DIORAMA_TEXT_READERS, or target/text-readers). MMOCR needs a Python with PyTorch: DIORAMA_TORCH_PYTHON, or /usr/bin/python3 with Debian's
# python3-torch. 0.7 GB.
#
#     benches/text_readers.sh target/text-readers
set -euo pipefail
folder="${1:?usage: benches/text_readers.sh FOLDER}"
python="${DIORAMA_TORCH_PYTHON:-/usr/bin/python3}"
"$python" -c 'import torch' || { echo "$python has no torch; Debian: apt install python3-torch" >&2; exit 1; }
mkdir -p "$folder"
[ -x "$folder/venv/bin/python" ] || "$python" -m venv --system-site-packages "$folder/venv"
install() { "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }
install 'numpy<2' 'scipy<1.14' 'opencv-python-headless<4.11' mmengine==0.10.7 mmcv-lite==2.0.1 pycocotools shapely pyclipper imgaug lmdb rapidfuzz \
    scikit-image matplotlib six tqdm terminaltables
# Their own requirements would install networks and what runs them.
install --no-deps mmdet==3.0.0 mmocr==1.0.1 paddleocr==2.7.3
