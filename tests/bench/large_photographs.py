#!/usr/bin/env python3
"""Photographs that are much finer than the cloud: what reading them by cells of pixels (acquisition.binning) saves, and what it costs.

    python tests/bench/large_photographs.py SCENE … [--enlarge N] [--thin N] [--binning auto 1 …] [--memory SIZE] [--out DIR] [--chiaro EXE]

SCENE is a rendered scene with truth/ (docs/peers.md). --enlarge: its photographs have N times as many pixels a side, interpolated, with the camera's noise anew, in JPEG. --thin: the
cloud keeps every N-th point of a random order, so that photographs hold detail between its points. Runs the copy by the joint method with each binning and prints a row each. Needs
numpy, OpenEXR and pillow from PyPI. An enlargement of 12 makes photographs of 44 million pixels, and takes 35 GB of disk where each pixel is read by itself.
"""
import argparse
import multiprocessing
import re
import shutil
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "peers"))
import chiaro_runs  # noqa: E402
import scene_copy  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
HEADER = """| scene | pixels of a photograph, M | points | binning | cells | error of albedo, mean / median, % | after one factor, % | s | core-s | peak MiB | GB left by the run |
| --- | ---: | ---: | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |"""
SEED = 1
GAIN, READ = 4e-4, 4e-4   # of a pixel of the enlarged photographs


def enlarge(scene, copy, times):
    rng = np.random.default_rng(SEED)
    for photo in sorted((scene / "photos").glob("*.exr")):
        picture = scene_copy.read_exr(photo)
        size = (picture.shape[1] * times, picture.shape[0] * times)
        fine = np.stack([np.asarray(Image.fromarray(picture[..., c]).resize(size, Image.BICUBIC)) for c in range(3)], -1)
        fine = fine + rng.standard_normal(fine.shape, dtype=np.float32) * np.sqrt(GAIN * np.maximum(fine, 0) + READ**2)
        linear = np.clip(fine, 0, 1)
        srgb = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        (copy / "photos" / photo.name).unlink()
        Image.fromarray((srgb * 255 + 0.5).astype(np.uint8)).save(copy / "photos" / (photo.stem + ".jpg"), quality=95)
        mask = Image.open(scene / "masks" / (photo.stem + ".png")).resize(size, Image.NEAREST)
        (copy / "masks" / (photo.stem + ".png")).unlink()
        mask.save(copy / "masks" / (photo.stem + ".png"))
    cameras = []
    for line in (scene / "sparse/cameras.txt").read_text().splitlines():
        words = line.split()
        if not line.startswith("#") and words:
            words = words[:2] + [str(int(v) * times) for v in words[2:4]] + ["%.12g" % (float(v) * times) for v in words[4:]]
        cameras.append(" ".join(words))
    scene_copy.write_text(copy / "sparse/cameras.txt", "\n".join(cameras) + "\n")
    text = (scene / "project.toml").read_text().replace(".exr", ".jpg")
    text = re.sub(r"(?m)^noise\s*=.*\n", "", re.sub(r'(?m)^encoding\s*=.*', 'encoding = "srgb"', text))
    scene_copy.write_text(copy / "project.toml", text)


def thin(scene, copy, times):
    """The truth of the points that are left."""
    data = (scene / "cloud.ply").read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    truth = np.load(scene / "truth/albedo.npy")
    kept = np.sort(np.random.default_rng(SEED).permutation(len(truth))[:len(truth) // times])
    rows = np.frombuffer(data[start:], np.uint8).reshape(len(truth), -1)[kept]
    (copy / "cloud.ply").unlink()
    (copy / "cloud.ply").write_bytes(data[:start].replace(b"element vertex %d" % len(truth), b"element vertex %d" % len(kept)) + rows.tobytes())
    return truth[kept]


def measure(options, scene, copy, truth, binning):
    out = options.out / ("%s.%s.out" % (copy.name, binning))
    shutil.rmtree(out, ignore_errors=True)
    command = [str(options.chiaro), "run", str(copy / "project.toml"), "--out", str(out), "--memory", options.memory, "--set", "acquisition.binning=%s" % binning]
    log = options.out / (out.name + ".txt")
    log.unlink(missing_ok=True)
    start = time.monotonic()
    code, core, peak = chiaro_runs.timed(command, log)
    seconds = time.monotonic() - start
    lens = (copy / "sparse/cameras.txt").read_text().splitlines()[-1].split()
    cells = sorted(set(re.findall(r"cells of (\d+) x", log.read_text()))) if binning == "auto" else [binning]
    row = [scene.name, "%.1f" % (int(lens[2]) * int(lens[3]) / 1e6), str(len(truth)), binning, ", ".join("%s x %s" % (c, c) for c in cells) or "–"]
    if code not in (0, 3):
        return "| %s | exit %d |" % (" | ".join(row), code)
    table = chiaro_runs.read_ply(out / "albedo.ply")
    absolute, scaled = chiaro_runs.albedo_errors(np.stack([table["albedo_" + c] for c in "rgb"], 1).astype(float), truth)
    left = sum(p.stat().st_size for p in out.rglob("*") if p.is_file()) / 1e9
    shutil.rmtree(out)
    return "| %s | %.2f / %.2f | %.2f / %.2f | %.0f | %.0f | %.0f | %.2f |" % (" | ".join(row), *absolute, *scaled, seconds, core, peak, left)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--enlarge", type=int, default=1)
    parser.add_argument("--thin", type=int, default=1)
    parser.add_argument("--binning", nargs="+", default=["auto", "1"])
    parser.add_argument("--memory", default="512MiB")
    parser.add_argument("--out", type=Path, default=Path("large_photographs"))
    parser.add_argument("--chiaro", type=Path, default=ROOT / "build/release/chiaro")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print(HEADER, flush=True)
    for scene in options.scenes:
        copy = options.out / ("%s.x%d.thin%d" % (scene.name, options.enlarge, options.thin))
        scene_copy.link_scene(scene, copy)
        truth = np.load(scene / "truth/albedo.npy")
        if options.enlarge > 1:
            # In a process of its own: a child's largest resident set begins with its parent's.
            making = multiprocessing.get_context("spawn").Process(target=enlarge, args=(scene, copy, options.enlarge))
            making.start()
            making.join()
            if making.exitcode != 0:
                sys.exit("enlarging %s failed" % scene)
        if options.thin > 1:
            truth = thin(scene, copy, options.thin)
        for binning in options.binning:
            print(measure(options, scene, copy, truth, binning), flush=True)


if __name__ == "__main__":
    main()
