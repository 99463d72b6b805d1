"""Reads a data set that `diorama text synth` wrote with a toolbox's own loader; prints what it holds as JSON, sorted by image.

    python text_set_loaders.py ppocr SET    # PaddleOCR's SimpleDataSet: DecodeImage and DetLabelEncode
    python text_set_loaders.py mmocr SET    # MMOCR's OCRDataset: LoadImageFromFile and LoadOCRAnnotations

Each image: its name, height and width as decoded, and its words as polygon (x, y in turn), text and whether it is ignored.
`benches/text_readers.sh` installs both; either needs only its own packages.
"""

import importlib.util
import json
import logging
import os
import sys
import types


class Absent(types.ModuleType):
    """In place of a package whose compiled operations and augmentations loaders do not call."""

    __path__ = []

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__call__": lambda self, *arguments: None})


def replace_absent(names):
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError:
            sys.modules[name] = Absent(name)
            parent, _, child = name.rpartition(".")
            if parent:
                setattr(sys.modules[parent], child, sys.modules[name])


def ppocr(folder):
    replace_absent(["paddle", "paddle.io", "paddle.distributed", "paddle.vision", "paddle.vision.transforms"])
    # Its own package would load networks.
    sys.path.insert(0, os.path.dirname(importlib.util.find_spec("paddleocr").origin))
    from ppocr.data.simple_dataset import SimpleDataSet

    transforms = [
        {"DecodeImage": {"img_mode": "BGR", "channel_first": False}},
        {"DetLabelEncode": None},
        {"KeepKeys": {"keep_keys": ["image", "polys", "texts", "ignore_tags"]}},
    ]
    labels = [os.path.join(folder, "Label.txt")]
    dataset = {"data_dir": folder, "label_file_list": labels, "ratio_list": [1.0], "transforms": transforms}
    config = {"Global": {}, "Eval": {"dataset": dataset, "loader": {"shuffle": False}}}
    data = SimpleDataSet(config, "Eval", logging.getLogger("ppocr"))
    for k, line in enumerate(data.data_lines):
        name, label = line.decode("utf-8").strip("\n").split("\t")
        # The loader takes another image in place of one without words.
        if not json.loads(label):
            continue
        image, polygons, texts, ignored = data[k]
        words = [(p.reshape(-1).tolist(), t, bool(i)) for p, t, i in zip(polygons, texts, ignored)]
        yield name, image.shape, words


def mmocr(folder):
    replace_absent(["mmcv._ext", "torchvision", "torchvision.transforms", "torchvision.transforms.functional"])
    from mmengine.registry import init_default_scope
    from mmocr.datasets import OCRDataset

    init_default_scope("mmocr")
    pipeline = [
        {"type": "LoadImageFromFile", "color_type": "color_ignore_orientation"},
        {"type": "LoadOCRAnnotations", "with_bbox": True, "with_label": True, "with_polygon": True, "with_text": True},
    ]
    data = OCRDataset(ann_file="mmocr/textdet.json", data_root=folder, pipeline=pipeline, test_mode=True)
    for k in range(len(data)):
        got = data[k]
        boxes, polygons = got["gt_bboxes"], got["gt_polygons"]
        assert len(boxes) == len(polygons) == len(got["gt_texts"]) and set(got["gt_bboxes_labels"].tolist()) <= {0}, got
        for box, polygon in zip(boxes, polygons):
            xs, ys = polygon[0::2], polygon[1::2]
            assert abs(box - [xs.min(), ys.min(), xs.max(), ys.max()]).max() < 1e-3, (box, polygon)
        assert got["img"].shape[:2] == got["ori_shape"] == (got["height"], got["width"]), got["img_path"]
        words = [(p.tolist(), t, bool(i)) for p, t, i in zip(polygons, got["gt_texts"], got["gt_ignored"])]
        yield os.path.relpath(got["img_path"], folder), got["img"].shape, words


def main():
    toolbox, folder = sys.argv[1], sys.argv[2]
    # Loaders print; what counts is the last line.
    read = {"ppocr": ppocr, "mmocr": mmocr}[toolbox](folder)
    images = [{"image": name, "height": shape[0], "width": shape[1], "words": words} for name, shape, words in read]
    print(json.dumps(sorted(images, key=lambda i: i["image"])))


main()
