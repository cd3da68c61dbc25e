#!/usr/bin/env python3
"""How well a cloud of points can show a new view at all, beside how well `chiaro render` does.

usage: python3 tests/bench/novel_view_limit.py SCENE RENDERED DIRECT      (needs numpy, scipy, OpenEXR and pillow from PyPI)
SCENE: a rendered scene with truth/ and novel/. RENDERED, DIRECT: folders of `chiaro render` for novel/views.toml, the latter with --direct.

The limit of a view takes, for each pixel, the true surface point (truth/NAME_depth.exr) and blends the true albedo and the true normals of the nearest
points of the cloud there; whether the flash reaches the point is chosen after the fact, whichever comes closer to the photograph; ambient and bounced light
are those of the rendering. What it still misses lies between the points: paint edges and relief finer than the sampling. "albedo only" even takes the
shading from the photograph, so that it misses nothing but the albedo between the points. Several widths of the blend are tried, the best is printed.
"blurred": the photograph of the new view itself, averaged over squares as wide as the cloud's spacing (the median one, at the median distance): what is left
when relief, outlines and shadows are known as finely as the cloud samples them, and nothing else is wrong. "by place": with the spacing of the points at
each pixel, as it looks from there: what stands near is sampled more coarsely. Values are clipped to 0..1 everywhere.
"""
import sys
import tomllib
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image
from scipy.ndimage import binary_erosion, convolve, gaussian_filter
from scipy.spatial import cKDTree


def exr(path):
    channels = {name: np.asarray(c.pixels, dtype=float) for name, c in OpenEXR.File(str(path)).channels().items()}
    return channels["RGB"] if "RGB" in channels else np.stack([channels[c] for c in "RGB"], -1) if "R" in channels else next(iter(channels.values()))


def read_cloud(scene):
    data = (scene / "cloud.ply").read_bytes()
    start = data.index(b"end_header\n") + 11
    albedo = np.load(scene / "truth/albedo.npy").astype(float)
    values = np.frombuffer(data[start:], "<f4").reshape(len(albedo), -1).astype(float)
    truth = scene / "truth/normal.npy"
    normals = np.load(truth).astype(float) if truth.exists() else values[:, 3:6]
    return values[:, :3], normals, albedo


def psnr(picture, photograph):
    return -10 * np.log10(np.mean((np.clip(picture, 0, 1) - np.clip(photograph, 0, 1)) ** 2))


def blurred(photograph, mask, width):
    """Means over Gaussians with the variance of a square of that width, of what lies in the mask."""
    sigma = width / np.sqrt(12)
    weight = gaussian_filter(mask.astype(float), sigma)[mask]
    picture = np.zeros(mask.shape + (3,))
    picture[mask] = photograph
    return np.stack([gaussian_filter(picture[..., c], sigma)[mask] / weight for c in range(3)], -1)


def spacing_of(positions, some):
    """As docs/store-format.md has it: distance of the sixth neighbour / sqrt(6 / pi)."""
    return cKDTree(positions).query(some, 7, workers=-1)[0][:, 6] * np.sqrt(np.pi / 6)


def blurred_by_place(photograph, mask, widths):
    """As blurred(), each pixel with the width that is its own, between two of a ladder."""
    ladder = np.geomspace(max(0.3, widths.min()), max(0.4, widths.max()), 12)
    at = np.clip(np.interp(np.log(np.maximum(widths, 0.3)), np.log(ladder), np.arange(12)), 0, 10.999)
    steps = np.stack([blurred(photograph, mask, w) for w in ladder])
    low, share, pixel = at.astype(int), (at % 1)[:, None], np.arange(len(at))
    return (1 - share) * steps[low, pixel] + share * steps[low + 1, pixel]


SECOND_DIFFERENCES = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]]) / 6   # of unit variance on white noise; 0 on planes


def noise_variance(photograph, rendered, mask):
    """Mean variance of the photograph's noise over the mask, as a function of brightness from where the rendered picture is smooth."""
    inner = binary_erosion(mask, iterations=2)
    total = 0.0
    for c in range(3):
        noise = np.abs(convolve(photograph[..., c], SECOND_DIFFERENCES))[inner]
        relief = np.abs(convolve(rendered[..., c], SECOND_DIFFERENCES))[inner]
        level = rendered[..., c][inner]
        edges = np.quantile(level, np.linspace(0, 1, 13))
        for low, high in zip(edges[:-1], edges[1:]):
            some = (level >= low) & (level <= high) & (photograph[..., c][inner] < 1)
            if some.sum() < 50:   # saturated: no noise is left there
                continue
            smooth = some & (relief <= np.median(relief[some]))
            total += (np.median(noise[smooth]) / 0.6745) ** 2 * some.sum() / inner.sum() / 3
    return total


def measure(view, scene, rendered, direct, cloud):
    name, (width, height) = view["name"], view["size"]
    fx, fy, cx, cy = view["camera"]["params"]
    rotation, translation = np.array(view["rotation_camera_from_world"]), np.array(view["translation_camera_from_world"])
    mask = np.array(Image.open(scene / f"masks/{name}.png").convert("L")) > 127
    photograph, ours = exr(scene / f"novel/{name}.exr")[mask], exr(rendered / f"{name}.exr")[mask]
    indirect = ours - exr(direct / f"{name}.exr")[mask]
    depth = exr(scene / f"truth/{name}_depth.exr").reshape(height, width)[mask]
    ys, xs = np.nonzero(mask)
    rays = np.stack([(xs + 0.5 - cx) / fx, (ys + 0.5 - cy) / fy, np.ones(len(xs))], -1)
    points = (rays / np.linalg.norm(rays, axis=1)[:, None] * depth[:, None] - translation) @ rotation
    to_flash = rotation.T @ (np.array(view["flash_offset_in_camera"]) - translation) - points
    squared = (to_flash**2).sum(1)

    positions, normals, albedos = cloud
    distance, index = cKDTree(positions).query(points, 8, workers=-1)
    scale = 2 * np.median(distance[:, 0])
    limits, albedo_only = [], []
    for spread in (0.25, 0.5, 0.8, 1.2):
        weight = np.exp(-0.5 * ((distance - distance[:, :1]) / (spread * scale)) ** 2)[..., None]
        albedo = (albedos[index] * weight).sum(1) / weight.sum(1)
        normal = (normals[index] * weight).sum(1)
        cosine = np.maximum(0, (normal * to_flash).sum(1) / np.linalg.norm(normal, axis=1) / np.sqrt(squared))
        lit = albedo * (view["flash_intensity"] * cosine / squared / np.pi)[:, None] + indirect
        dark_is_closer = ((indirect - photograph) ** 2).mean(1) < ((lit - photograph) ** 2).mean(1)
        limits.append(psnr(np.where(dark_is_closer[:, None], indirect, lit), photograph))
        shading = (photograph * albedo).sum(1) / (albedo**2).sum(1)
        albedo_only.append(psnr(shading[:, None] * albedo, photograph))
    along_axis = ((points @ rotation.T) + translation)[:, 2]
    pixels = np.median(spacing_of(positions, positions[:: max(1, len(positions) // 20000)])) * fx / np.median(depth)
    clipped = np.clip(photograph, 0, 1)
    limit = psnr(blurred(clipped, mask, pixels), photograph)
    by_place = psnr(blurred_by_place(clipped, mask, spacing_of(positions, positions[index[:, 0]]) * fx / along_axis), photograph)
    noise = noise_variance(*(np.clip(exr(folder / f"{name}.exr"), 0, 1) for folder in (scene / "novel", rendered)), mask)
    clean = 10 ** (-psnr(ours, photograph) / 10) - noise
    print(f"| {scene.name}/{name} | {psnr(ours, photograph):.1f} | {max(limits):.1f} | {max(albedo_only):.1f} | {pixels:.1f} | {limit:.1f} | {by_place:.1f} | {-10 * np.log10(noise):.1f} | {-10 * np.log10(clean):.1f} |")


def main():
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    scene, rendered, direct = map(Path, sys.argv[1:])
    cloud = read_cloud(scene)
    print("| view | chiaro, PSNR dB | limit of the cloud | albedo only | spacing, pixels | blurred | by place | own noise | without it |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for view in tomllib.loads((scene / "novel/views.toml").read_text())["view"]:
        measure(view, scene, rendered, direct, cloud)


if __name__ == "__main__":
    main()
