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

The second table says where chiaro's squared error lies. A pixel counts at the first of these places: "outline", within 1.5 pixels of a step of the true depth;
"not photographed", no photograph of the scene sees the point; "shadow", within 1.5 pixels of where the photograph goes from lit to dark on a surface that faces
the flash; "paint", where true albedos of neighbouring pixels differ by a quarter; "inside", all others; of these "low" is what 4 pixels around have in common. Each with its
share of the pixels, of the error, and with the PSNR that would be reached were it perfect.
"""
import sys
import tomllib
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image
from scipy.ndimage import binary_erosion, convolve, distance_transform_edt, gaussian_filter, maximum_filter, median_filter, minimum_filter
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


def rotation_of(w, x, y, z):
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def photographs(scene):
    """Depth along the rays, rotation and translation from the world, and pinhole parameters of each."""
    rows = lambda name: [line.split() for line in (scene / f"sparse/{name}.txt").read_text().splitlines() if line.strip() and line[0] != "#"]
    cameras = {r[0]: [float(v) for v in r[4:8]] for r in rows("cameras")}
    for r in rows("images"):
        if len(r) == 10 and r[8] in cameras:
            yield exr(scene / f"truth/{Path(r[9]).stem}_depth.exr").squeeze(), rotation_of(*map(float, r[1:5])), np.array(r[5:8], float), cameras[r[8]]


def photographed(points, scene):
    """Does a photograph see the point, its depth there within three pixels and 3 mm?"""
    seen = np.zeros(len(points), bool)
    for depth, rotation, translation, (fx, fy, cx, cy) in photographs(scene):
        at = points @ rotation.T + translation
        distance = np.linalg.norm(at, axis=1)
        x, y = (np.floor(at[:, k] / at[:, 2] * f + c).astype(int) for k, f, c in ((0, fx, cx), (1, fy, cy)))
        inside = (at[:, 2] > 0) & (x >= 1) & (y >= 1) & (x < depth.shape[1] - 1) & (y < depth.shape[0] - 1)
        x, y = np.clip(x, 1, depth.shape[1] - 2), np.clip(y, 1, depth.shape[0] - 2)
        off = np.min([np.abs(depth[y + j, x + i] - distance) for j in (-1, 0, 1) for i in (-1, 0, 1)], axis=0)
        seen |= inside & (off < 3 * distance / fx + 0.003)
    return seen


def on_picture(values, mask):
    picture = np.zeros(mask.shape + values.shape[1:], values.dtype)
    picture[mask] = values
    return picture


def outlines(along_axis, fx):
    """Pixels whose depth is off a neighbour's, and off the line through both neighbours, by pixels."""
    found = np.zeros(along_axis.shape, bool)
    for axis in (0, 1):
        before, after = np.roll(along_axis, 1, axis), np.roll(along_axis, -1, axis)
        bent = np.abs(before - 2 * along_axis + after) > 4 * along_axis / fx
        found |= bent & (np.maximum(np.abs(before - along_axis), np.abs(after - along_axis)) > 6 * along_axis / fx)
    return found


def shadow_edges(photograph, lit, indirect, faces_flash, mask):
    """Where surfaces that face the flash go from lit to dark. lit: by the flash alone, were there no shadow."""
    share = np.zeros(mask.shape)
    share[mask] = ((photograph - indirect) * lit).sum(1) / np.maximum((lit**2).sum(1), 1e-9)
    known = np.zeros(mask.shape, bool)
    known[mask] = faces_flash & (lit.mean(1) > 0.02)
    bright = median_filter(share, 3) > 0.5
    return maximum_filter(known & bright, 3) & maximum_filter(known & ~bright, 3) & known


def places(error, mask, near_outline, seen, near_shadow, albedo):
    """(place, pixels, squared error) of each, and of what is low in the last. error: (H, W, 3), 0 off the mask."""
    grey = np.zeros(mask.shape)
    grey[mask] = albedo.mean(1)
    paint = maximum_filter(grey, 3) - minimum_filter(np.where(mask, grey, 9), 3) > 0.25 * np.maximum(grey, 0.02)
    left, found = mask.copy(), []
    for name, there in (("outline", near_outline), ("not photographed", ~seen), ("shadow", near_shadow), ("paint", paint), ("inside", mask)):
        found.append((name, (left & there).sum(), (error[left & there] ** 2).mean(1).sum()))
        left, inside = left & ~there, left & there
    weight = np.maximum(gaussian_filter(inside.astype(float), 4), 1e-6)[..., None]
    common = gaussian_filter(error * inside[..., None], (4, 4, 0)) / weight
    return found + [("low", inside.sum(), found[-1][2] - ((error - common)[inside] ** 2).mean(1).sum())]


def measure(view, scene, rendered, direct, cloud):
    """Prints the view's row of the first table; returns that of the second."""
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
    limits, albedo_only, lights = [], [], []
    for spread in (0.25, 0.5, 0.8, 1.2):
        weight = np.exp(-0.5 * ((distance - distance[:, :1]) / (spread * scale)) ** 2)[..., None]
        albedo = (albedos[index] * weight).sum(1) / weight.sum(1)
        normal = (normals[index] * weight).sum(1)
        cosine = np.maximum(0, (normal * to_flash).sum(1) / np.linalg.norm(normal, axis=1) / np.sqrt(squared))
        lit = albedo * (view["flash_intensity"] * cosine / squared / np.pi)[:, None] + indirect
        lights.append((lit - indirect, cosine > 0.1, albedo))
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

    flash_alone, faces_flash, albedo = lights[1]
    error = on_picture(np.clip(ours, 0, 1) - clipped, mask)
    near = lambda edges: distance_transform_edt(~edges) <= 1.5
    depth_along_axis = np.where(mask, on_picture(along_axis, mask), 1e3)
    found = places(error, mask, near(outlines(depth_along_axis, fx)), on_picture(photographed(points, scene), mask), near(shadow_edges(photograph, flash_alone, indirect, faces_flash, mask)), albedo)
    total, pixels = (error**2).mean(2).sum(), mask.sum()
    return f"| {scene.name}/{name} | " + " | ".join(f"{100 * n / pixels:.1f}, {100 * e / total:.1f}, {-10 * np.log10((total - e) / pixels):.1f}" for _, n, e in found) + " |"


def main():
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    scene, rendered, direct = map(Path, sys.argv[1:])
    cloud = read_cloud(scene)
    print("| view | chiaro, PSNR dB | limit of the cloud | albedo only | spacing, pixels | blurred | by place | own noise | without it |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    rows = [measure(view, scene, rendered, direct, cloud) for view in tomllib.loads((scene / "novel/views.toml").read_text())["view"]]
    print("\n| view: % of pixels, % of error, PSNR dB were it perfect | outline | not photographed | shadow | paint | inside | of that, low |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
