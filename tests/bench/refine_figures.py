#!/usr/bin/env python3
"""What inserted points (blend.refine = "image") are worth: their albedo against truth, and new views from the points alone.

usage: python3 tests/bench/refine_figures.py CHIARO SCENE PLAIN REFINED [--picture FILE.png]      (needs numpy, scipy, OpenEXR, pillow from PyPI)
SCENE: a rendered scene with sparse/ (COLMAP text, PINHOLE), the true albedo of its photographs as blend/photo_NN.exr, truth/photo_NN_depth.exr, and novel/. PLAIN, REFINED: folders of
two finished runs of it, without and with the option.

  cloud's points, inserted   |a - truth| / truth, mean of the channels, per cent, mean / median, truth being read in the true albedo of the nearest photograph (bilinear, away from edges of depth)
  interpolated               the same at the places of the inserted points, from the cloud's points: inverse distances to the four nearest seen ones. What a viewer shows without inserted points
  sharpness                  how much of truth's steps between neighbouring points is there (slope of steps against truth's), and the correlation of both
  new views                  `chiaro render --points` against the photographs of novel/, PSNR and SSIM
--picture: the middle of the last new view, from the cloud's points, with the inserted ones, as photographed.
"""
import argparse
import json
import subprocess
from pathlib import Path

import numpy as np
import OpenEXR
from blend_figures import bilinear, cameras, mean_median, neighbours, ply, relative
from scipy.spatial import cKDTree


def exr(path):
    channels = {}
    for name, channel in OpenEXR.File(str(path)).channels().items():
        channels[name] = np.asarray(channel.pixels, float)
    if len(channels) == 1:
        image = next(iter(channels.values()))
        return image if image.ndim == 2 or image.shape[-1] > 1 else image[..., 0]
    return np.stack([channels[c] for c in ("R", "G", "B")], -1)


def true_albedo(scene, points):
    """Of each point, in the nearest photograph that shows it; NaN where none does."""
    truth, best = np.full((len(points), 3), np.nan), np.full(len(points), np.inf)
    for stem, (rotation, translation, (fx, fy, cx, cy)) in cameras(scene / "sparse").items():
        picture, depths = scene / f"blend/{stem}.exr", scene / f"truth/{stem}_depth.exr"
        if not picture.exists():
            continue
        albedo, depth = exr(picture)[..., :3], exr(depths)
        depth = depth if depth.ndim == 2 else depth[..., 0]
        height, width = depth.shape
        local = points @ rotation.T + translation
        distance = np.linalg.norm(local, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            px, py = fx * local[:, 0] / local[:, 2] + cx - 0.5, fy * local[:, 1] / local[:, 2] + cy - 0.5
        inside = np.nonzero((local[:, 2] > 0) & (px >= 2) & (px < width - 3) & (py >= 2) & (py < height - 3))[0]
        x, y = np.floor(px[inside]).astype(int), np.floor(py[inside]).astype(int)
        window = np.stack([depth[y + j, x + i] for j in range(-1, 3) for i in range(-1, 3)], -1)
        near = (np.abs(window - distance[inside, None]) < 0.004 * distance[inside, None] + 3 * distance[inside, None] / fx).all(1)   # no edge
        chosen = inside[near & (distance[inside] / fx < best[inside])]
        best[chosen] = distance[chosen] / fx
        truth[chosen] = bilinear(albedo, px[chosen], py[chosen])
    return truth


def albedo_of(points):
    return np.stack([points["albedo_" + c] for c in "rgb"], -1).astype(float)


def interpolated(places, points, albedo):
    distance, index = cKDTree(points).query(places, 4, workers=-1)
    weight = 1 / (distance + 1e-9)
    return np.sum(albedo[index] * weight[..., None], 1) / weight.sum(1)[:, None]


def places_of(points):
    return np.stack([points[c] for c in "xyz"], -1).astype(float)


def errors(scene, refined):
    points = ply(refined / "albedo.ply")
    places, albedo, new = places_of(points), albedo_of(points), points["inserted"] == 1
    seen = points["photos"] > 0
    own = np.nonzero(~new & seen)[0]
    truth = true_albedo(scene, places)
    known = np.isfinite(truth).all(1) & (truth > 1e-3).all(1)
    cloud, inserted = own[known[own]], np.nonzero(new & known)[0]
    between = interpolated(places[inserted], places[own], albedo[own])
    i, j = neighbours(places, inserted)
    steps = truth[i] - truth[j]

    def sharp(colours):
        full = np.zeros_like(truth)
        full[inserted] = colours
        found = full[i] - full[j]
        return f"{np.sum(found * steps) / np.sum(steps * steps):.3f}, {np.sum(found * steps) / np.sqrt(np.sum(found * found) * np.sum(steps * steps)):.3f}"

    print(f"cloud's points  {mean_median(relative(albedo[cloud], truth[cloud]))} %   ({len(cloud)} of {len(own)} seen)")
    print(f"inserted        {mean_median(relative(albedo[inserted], truth[inserted]))} %   ({len(inserted)} of {new.sum()}), sharpness {sharp(albedo[inserted])}")
    print(f"interpolated    {mean_median(relative(between, truth[inserted]))} %, sharpness {sharp(between)}")


def views(chiaro, scene, plain, refined):
    print("| new view | points alone, PSNR / SSIM | with inserted points |\n| --- | --- | --- |")
    rows = {}
    for run in (plain, refined):
        out = run.parent / (run.name + ".views")
        subprocess.run([chiaro, "render", run, "--views", scene / "novel/views.toml", "--points", "--out", out, "--quiet"], check=True, capture_output=True)
        for view in sorted((scene / "novel").glob("*.exr")):
            found = subprocess.run([chiaro, "compare", out / view.name, view, "--mask", scene / "masks" / (view.stem + ".png"), "--json"], check=True, capture_output=True, text=True)
            result = json.loads(found.stdout[found.stdout.rindex('{"event":"result"') :])
            rows.setdefault(view.stem, []).append(f"{result['psnr']:.2f} dB / {result['ssim']:.3f}")
    for name, values in rows.items():
        print(f"| {name} | {' | '.join(values)} |")


def picture(scene, plain, refined, path):
    from PIL import Image

    view = sorted((scene / "novel").glob("*.exr"))[-1]
    pictures = [exr(run.parent / (run.name + ".views") / view.name) for run in (plain, refined)] + [exr(view)]
    height, width = pictures[-1].shape[:2]
    y, x, h, w = height * 3 // 8, width * 3 // 8, height // 3, width // 3
    white = np.quantile(pictures[-1], 0.99)
    shown = []
    for image in pictures:
        linear = np.clip(image[y : y + h, x : x + w, :3] / white, 0, 1)
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        shown.append(np.kron(np.rint(255 * encoded).astype("u1"), np.ones((2, 2, 1), "u1")))
        shown.append(np.full((2 * h, 8, 3), 255, "u1"))
    Image.fromarray(np.concatenate(shown[:-1], 1)).save(path, optimize=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("chiaro")
    for name in ("scene", "plain", "refined"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    errors(options.scene, options.refined)
    views(options.chiaro, options.scene, options.plain, options.refined)
    if options.picture:
        picture(options.scene, options.plain, options.refined, options.picture)


if __name__ == "__main__":
    main()
