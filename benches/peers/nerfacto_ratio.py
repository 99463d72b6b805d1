#!/usr/bin/env python3
"""Training rays per second and held-out PSNR of diorama and of nerfstudio's nerfacto, side by side.

    python -m venv v && v/bin/pip install nerfstudio            # about 4 minutes
    v/bin/python benches/peers/nerfacto_ratio.py FOX --diorama target/release/diorama

FOX is a capture with transforms.json and photographs of one size. Both train on the photographs at 1/4 size with
every eighth one held out, one after the other on the same threads: nerfacto through nerfstudio's own Trainer, with
its own losses, samplers and schedule in PyTorch, which is the only implementation of it for CPUs. nerfacto's PSNR
is taken over a fixed random subset of each held-out view's pixels, because it takes minutes to render one view.
"""
import argparse
import copy
import json
import math
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
import types

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("capture", type=pathlib.Path)
parser.add_argument("--diorama", type=pathlib.Path, default="target/release/diorama")
parser.add_argument("--downscale", type=int, default=4)
parser.add_argument("--threads", type=int, default=2)
parser.add_argument("--seconds", type=float, default=90, help="training time of diorama")
parser.add_argument("--peer-seconds", type=float, default=90, help="training time of nerfacto")
parser.add_argument("--peer-rays", type=int, default=4096, help="rays per step of nerfacto (4096 is its own default)")
parser.add_argument("--peer-pixels", type=int, default=2048, help="pixels per held-out view for nerfacto's PSNR; 0: none")
parser.add_argument("--set", action="append", default=[], help="passed on to diorama train")
args = parser.parse_args()


def resized_copy(capture, out):
    """nerfstudio wants photographs at the wanted size in images_N and the split by file name."""
    from PIL import Image

    text = json.loads((capture / "transforms.json").read_text())
    frames = [f for f in text["frames"] if (capture / f["file_path"]).exists()]
    for sub in ("images", f"images_{args.downscale}"):
        (out / sub).mkdir(parents=True)
    for f in frames:
        name = pathlib.Path(f["file_path"]).name
        photo = Image.open(capture / f["file_path"])
        small = photo.resize((photo.width // args.downscale, photo.height // args.downscale), Image.BOX)
        small.save(out / f"images_{args.downscale}" / name, quality=95)
        (out / "images" / name).symlink_to((capture / f["file_path"]).resolve())
        f["file_path"] = f"images/{name}"
    names = [f["file_path"] for f in frames]
    text.update(frames=frames, test_filenames=names[::8], val_filenames=names[::8])
    text["train_filenames"] = [n for i, n in enumerate(names) if i % 8]
    (out / "transforms.json").write_text(json.dumps(text))


def peer(data):
    """nerfacto's rays per second, iterations and PSNR."""
    for missing in ("viser", "gsplat", "rawpy", "tensorly", "fpsample", "open3d", "pymeshlab", "wandb", "comet_ml"):
        try:
            __import__(missing)
        except Exception:
            # Imported by nerfstudio for its viewer and other methods, never called here.
            class Empty(types.ModuleType):
                def __getattr__(self, name):
                    if name.startswith("__"):
                        raise AttributeError(name)
                    return type(name, (), {})

            sys.modules[missing] = Empty(missing)
    import torch
    import torchmetrics.image.lpip

    class NoMetric(torch.nn.Module):
        def __init__(self, *_, **__):
            super().__init__()

    torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = NoMetric  # its weights are a download
    torch.set_num_threads(args.threads)
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
    from nerfstudio.engine.callbacks import TrainingCallbackLocation as At
    import nerfstudio.models.nerfacto as nerfacto

    nerfacto.LearnedPerceptualImagePatchSimilarity = NoMetric
    config = copy.deepcopy(method_configs["nerfacto"])
    config.machine.device_type, config.mixed_precision, config.vis = "cpu", False, "tensorboard"
    config.output_dir = data / "out"
    config.logging.steps_per_log, config.logging.local_writer.enable, config.logging.profiler = 10**9, False, "none"
    config.max_num_iterations = 10**7
    config.pipeline.model.implementation = "torch"
    config.pipeline.datamanager = VanillaDataManagerConfig(
        train_num_rays_per_batch=args.peer_rays,
        dataparser=NerfstudioDataParserConfig(data=data, downscale_factor=args.downscale, eval_mode="filename"),
    )
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.pipeline.train()
    spent, steps = 0.0, 0
    while spent < args.peer_seconds:
        begin = time.perf_counter()
        for c in trainer.callbacks:
            c.run_callback_at_location(steps, location=At.BEFORE_TRAIN_ITERATION)
        trainer.train_iteration(steps)
        for c in trainer.callbacks:
            c.run_callback_at_location(steps, location=At.AFTER_TRAIN_ITERATION)
        spent += time.perf_counter() - begin
        steps += 1
    if args.peer_pixels == 0:
        return steps * args.peer_rays / spent, steps, None
    trainer.pipeline.eval()
    scores = []
    with torch.no_grad():
        for n, (camera, batch) in enumerate(trainer.pipeline.datamanager.fixed_indices_eval_dataloader):
            truth = batch["image"][..., :3].reshape(-1, 3)
            pick = torch.randperm(len(truth), generator=torch.Generator().manual_seed(n))[: args.peer_pixels]
            rays = camera.generate_rays(camera_indices=0, keep_shape=True).flatten()[pick]
            shown = trainer.pipeline.model(rays)["rgb"].clamp(0, 1)
            scores.append(-10 * math.log10(float(torch.mean((shown - truth[pick]) ** 2))))
    return steps * args.peer_rays / spent, steps, statistics.mean(scores)


def ours(folder):
    """diorama's rays per second and PSNR, over whole held-out views."""
    run = folder / "run"
    train = [args.diorama, "train", args.capture, "-o", run, "--downscale", str(args.downscale), "--split", "every:8"]
    train += ["--seconds", str(args.seconds), "--threads", str(args.threads), "--json"]
    train += [part for s in args.set for part in ("--set", s)]
    summary = json.loads(subprocess.run(train, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL).stdout)
    score = subprocess.run([args.diorama, "eval", run, "--json"], check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL).stdout
    return summary["rays_per_s"], summary["steps"], json.loads(score)["psnr"]


with tempfile.TemporaryDirectory() as folder:
    folder = pathlib.Path(folder)
    own = ours(folder)
    data = folder / "nerfstudio"
    data.mkdir()
    resized_copy(args.capture, data)
    theirs = peer(data)
    print(f"diorama   {own[0]:10.0f} rays/s  {own[1]:6d} steps in {args.seconds:.0f} s  {own[2]:.2f} dB")
    psnr = "" if theirs[2] is None else f"  {theirs[2]:.2f} dB"
    print(f"nerfacto  {theirs[0]:10.0f} rays/s  {theirs[1]:6d} steps in {args.peer_seconds:.0f} s{psnr}")
    print(f"ratio     {own[0] / theirs[0]:10.1f}")
