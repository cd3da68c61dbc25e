#!/usr/bin/env python3
"""What one disturbed photograph does to the blend, and whether the run names it.

usage: python3 tests/bench/blend_disturbed.py PROJECT OUT [--photograph STEM …] [--chiaro FILE] [--set KEY=VALUE …]      (needs numpy, scipy, OpenEXR from PyPI)
PROJECT: project file of a rendered scene (photographs as EXR, cameras in sparse/, truth/albedo.npy). OUT: a folder for the runs.

Disturbances: exposure x 1.3; shifted by 2 pixels to the right; a disc of another object, 40 pixels wide; a highlight. Disc and highlight are put where
most of what they cover is seen by three photographs or more; what only one photograph sees cannot be told by any method. Prints error, mean / median in
per cent over all points seen, how many times the undisturbed one that is, and what the run's record says of the photograph.
"""
import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from blend_figures import Figures, cameras, mean_median, relative  # noqa: E402
from scene_copy import link_scene, read_exr, write_exr  # noqa: E402


def best_place(figures, camera, k, width, height):
    """Middle of a disc that points of three photographs or more fill best, pixels."""
    sees = np.stack([w for _, w in figures.single], -1) > 0
    points = figures.points[sees[:, k]]
    many = sees[sees[:, k]].sum(1) >= 3
    rotation, translation, (fx, fy, cx, cy) = camera
    local = points @ rotation.T + translation
    x, y = fx * local[:, 0] / local[:, 2] + cx, fy * local[:, 1] / local[:, 2] + cy
    best = (-1.0, None, 0.0)
    for v in range(40, height - 40, 10):
        for u in range(40, width - 40, 10):
            near = (x - u) ** 2 + (y - v) ** 2 < 24**2
            score = np.sum(many & near) - 4 * np.sum(~many & near)
            if score > best[0]:
                best = (score, (u, v), np.mean(many[near]))
    return best[1], best[2]


def disturbed(picture, kind, place):
    height, width, _ = picture.shape
    y, x = np.mgrid[0:height, 0:width] + 0.5
    squared = (x - place[0]) ** 2 + (y - place[1]) ** 2
    typical = np.median(picture[squared < 20**2], axis=0)
    if kind == "exposure x 1.3":
        return picture * 1.3
    if kind == "shifted by 2 px":
        return np.concatenate([picture[:, :1], picture[:, :1], picture[:, :-2]], 1)
    if kind == "disc":
        return np.where((squared < 20**2)[..., None], typical * np.array([0.3, 0.6, 1.2], np.float32), picture)
    return picture + (2 * typical.max() * np.exp(-squared / (2 * 8**2)))[..., None]


def run(chiaro, project, out, settings):
    command = [chiaro, "run", project, "--out", out, "--quiet"]
    for s in settings:
        command += ["--set", s]
    result = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    if result.returncode not in (0, 3):
        sys.exit(f"{' '.join(map(str, command))}: exit {result.returncode}\n{result.stderr}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--photograph", nargs="+", default=["photo_01"])
    parser.add_argument("--chiaro", type=Path, default=Path(__file__).parents[2] / "build/release/chiaro")
    parser.add_argument("--set", nargs="+", default=[])
    parser.add_argument("--only", nargs="+", default=["exposure", "shifted", "disc", "highlight"], help="first words of disturbances")
    words = parser.parse_args()
    scene, base = words.project.parent, words.out / "undisturbed"
    base.parent.mkdir(parents=True, exist_ok=True)
    run(words.chiaro, words.project, base, words.set)
    figures = Figures(scene, base)
    before = figures.error()
    print(f"| photograph | disturbance | error, % | times undisturbed | seen, % | what the record says |\n| --- | --- | ---: | ---: | ---: | --- |")
    print(f"| – | – | {mean_median(before)} | 1 | {100 * len(before) / len(figures.points):.2f} | |")
    folder = "blend" if "blend/" in words.project.read_text() else "photos"
    for stem in words.photograph:
        source = scene / folder / f"{stem}.exr"
        picture = read_exr(source)
        place, share = best_place(figures, cameras(scene / "sparse")[stem], figures.names.index(stem), picture.shape[1], picture.shape[0])
        for kind in ("exposure x 1.3", "shifted by 2 px", "disc", "highlight"):
            if kind.split()[0] not in words.only:
                continue
            name = f"{stem}.{kind.split()[0]}"
            copy, out = words.out / (name + ".scene"), words.out / name
            shutil.rmtree(out, ignore_errors=True)
            link_scene(scene, copy)
            shutil.copytree(base, out)
            write_exr(copy / folder / f"{stem}.exr", disturbed(picture, kind, place))
            run(words.chiaro, copy / words.project.name, out, words.set)
            after = Figures(scene, out)
            error = after.error()
            record = json.loads((out / "run.json").read_text())
            said = "; ".join(n for n in record.get("notes", []) if stem in n)
            where = f"{kind} at {place[0]}, {place[1]} ({100 * share:.0f} % of it seen by 3)" if kind in ("disc", "highlight") else kind
            print(f"| {stem} | {where} | {mean_median(error)} | {np.mean(error) / np.mean(before):.3f} | {100 * len(error) / len(figures.points):.2f} | {said} |", flush=True)


if __name__ == "__main__":
    main()
