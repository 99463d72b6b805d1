"""Runs an ONNX file in ONNX Runtime, as crates/pipelines/src/text/detectors/tests.rs asks: input and outputs are raw f32.

    python benches/peers/onnx_outputs.py MODEL INPUT N,C,H,W FOLDER    writes FOLDER/NAME.f32 for each output
"""

import sys
from pathlib import Path

import numpy as np
import onnxruntime

model, source, shape, folder = sys.argv[1:]
x = np.fromfile(source, np.float32).reshape([int(n) for n in shape.split(",")])
session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
names = [o.name for o in session.get_outputs()]
for name, value in zip(names, session.run(names, {session.get_inputs()[0].name: x})):
    value.tofile(Path(folder) / f"{name}.f32")
    print(name, *value.shape)
