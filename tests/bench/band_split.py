#!/usr/bin/env python3
"""Two ways to split photographs into bands before they are blended on points: on the surface, and in image pyramids that are read at the surface's scale.

usage: python3 -W ignore tests/bench/band_split.py SCENE RUN      (needs numpy, scipy, blosc from PyPI; SCENE and RUN as for blend_figures.py)

Both take the run's working images, the same weights (cos^2 / footprint^2, falling to 0 over 12 pixels towards silhouettes and the image border; to the power of 1 in the
lowest band, 1.5 in the highest, evenly between) and the same reading at points, so that only the split differs:
  surface   mean over the pixels whose surface lies within a radius of the pixel's own, weighted by their area and 1 - (distance / radius)^2
  pyramid   Gaussian pyramid of the image (masked pixels take no part), read between the two levels whose widths on the surface enclose that kernel's
Columns: error |a - truth| / truth of points that two photographs or more see, mean / median, per cent; seam as in blend_figures.py, and away from edges as in
blend_seams.py; sharpness as in blend_figures.py; how far the lowest bands of two photographs of a point are apart (median, per cent); seconds to split all photographs (numpy).
"""
import json
import time

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from blend_figures import Figures, bilinear, cameras, mean_median, neighbours, raster, relative, scene_and_run, seam, sharpness
from blend_seams import edge_distance, uneven_light

BORDER_PX = 12
MOST_PX = 24


class Photograph:
    def __init__(self, folder, camera):
        g = raster(folder / "gbuffer.raster", {"depth", "cosv", "footprint", "edge"})
        a = raster(folder / "albedo.raster", {"r", "g", "b"})
        self.albedo = np.stack([a[c] for c in "rgb"], -1).astype(np.float32)
        self.footprint = g["footprint"].astype(np.float32)
        height, width = g["depth"].shape
        _, _, (fx, fy, cx, cy) = camera
        y, x = np.mgrid[0:height, 0:width] + 0.5
        ray = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1)
        self.place = (g["depth"][..., None] * ray / np.linalg.norm(ray, axis=-1, keepdims=True)).astype(np.float32)
        self.used = (g["depth"] > 0) & (g["edge"] > 1) & (g["cosv"] > 0.19) & np.isfinite(self.albedo).all(-1)
        self.area = np.where(self.used, self.footprint**2 / np.maximum(g["cosv"], 0.19), 0).astype(np.float32)
        self.albedo[~self.used] = 0
        t = np.clip((g["edge"] - 1) / BORDER_PX, 0, 1)
        self.ramp = (t * t * (3 - 2 * t)).astype(np.float32)


def surface_mean(p, radius):
    reach = min(MOST_PX, int(np.ceil(radius / np.percentile(p.footprint[p.used], 2))))
    step = max(1, reach // 6)   # every second pixel, or third, of a wide one
    height, width = p.used.shape
    total, weight = np.zeros_like(p.albedo), np.zeros((height, width), np.float32)
    for dy in range(-(reach // step) * step, reach + 1, step):
        for dx in range(-(reach // step) * step, reach + 1, step):
            to = slice(max(0, -dy), min(height, height - dy)), slice(max(0, -dx), min(width, width - dx))
            of = slice(max(0, dy), min(height, height + dy)), slice(max(0, dx), min(width, width + dx))
            squared = ((p.place[of] - p.place[to]) ** 2).sum(-1)
            w = np.maximum(0, 1 - squared / radius**2) * p.area[of]
            total[to] += w[..., None] * p.albedo[of]
            weight[to] += w
    return np.where(weight[..., None] > 0, total / np.maximum(weight, 1e-20)[..., None], p.albedo)


def pyramid_mean(p, radius):
    """The kernel of surface_mean has a standard deviation of radius / sqrt(6) along each axis."""
    levels = []
    values, mask, step, sigma = p.albedo * p.used[..., None], p.used.astype(np.float32), 1, 0.0
    while min(mask.shape) > 8 and sigma < MOST_PX:
        levels.append((sigma, step, values / np.maximum(mask, 1e-6)[..., None]))
        blur = 1.0
        values = np.stack([gaussian_filter(values[..., c], blur) for c in range(3)], -1)[::2, ::2]
        mask = gaussian_filter(mask, blur)[::2, ::2]
        sigma = np.sqrt(sigma**2 + (blur * step) ** 2)
        step *= 2
    wanted = np.clip(radius / np.sqrt(6) / np.maximum(p.footprint, 1e-9), levels[0][0], levels[-1][0] - 1e-3)
    y, x = np.mgrid[0 : p.used.shape[0], 0 : p.used.shape[1]].astype(np.float32)
    result = np.zeros_like(p.albedo)
    for (fine, fine_step, a), (coarse, coarse_step, b) in zip(levels[:-1], levels[1:]):
        here = p.used & (wanted >= fine) & (wanted < coarse)
        if not here.any():
            continue
        t = ((wanted[here] ** 2 - fine**2) / (coarse**2 - fine**2))[:, None]
        at = [np.stack([map_coordinates(one[..., c], [y[here] / s, x[here] / s], order=1, mode="nearest") for c in range(3)], -1) for one, s in ((a, fine_step), (b, coarse_step))]
        result[here] = (1 - t) * at[0] + t * at[1]
    return result


def blended(f, photographs, poses, splits, bands):
    """Albedo per point, and how far the lowest bands of two photographs are apart."""
    n = len(f.points)
    power = [1 + 0.5 * k / (bands - 1) for k in range(bands)]
    weight, total = np.zeros((bands, n)), np.zeros((bands, n, 3))
    first, apart = np.full((n, 3), np.nan), []
    for k, p in enumerate(photographs):
        means = splits[k][: bands - 1]   # narrow ones first
        images = [means[-1]] + [means[b - 1] - means[b] for b in range(bands - 2, 0, -1)] + [p.albedo - means[0]]
        own = np.nonzero(f.single[k][1] > 0)[0]
        rotation, translation, (fx, fy, cx, cy) = poses[f.names[k]]
        local = f.points[own] @ rotation.T + translation
        px, py = fx * local[:, 0] / local[:, 2] + cx - 0.5, fy * local[:, 1] / local[:, 2] + cy - 0.5
        x, y = px.astype(int), py.astype(int)
        whole = p.used[y, x] & p.used[y, x + 1] & p.used[y + 1, x] & p.used[y + 1, x + 1]
        own, px, py, x, y = own[whole], px[whole], py[whole], x[whole], y[whole]
        w = f.single[k][1][own] * np.maximum(bilinear(p.ramp[..., None].astype(float), px, py)[:, 0], 1e-6)
        for b in range(bands):
            value = bilinear(images[b].astype(float), px, py)
            weight[b, own] += w ** power[b]
            total[b, own] += w[:, None] ** power[b] * value
            if b == 0:
                known = np.isfinite(first[own, 0])
                apart.append(np.abs(value[known] - first[own][known]).mean(1) / np.maximum(first[own][known].mean(1), 1e-3))
                first[own] = value
    return (total / np.maximum(weight, 1e-300)[..., None]).sum(0), weight[0] > 0, 100 * np.median(np.concatenate(apart))


def main():
    words = scene_and_run(__doc__).parse_args()
    f = Figures(words.scene, words.run)
    poses = cameras(words.scene / "sparse")
    photographs = [Photograph(words.run / "work/photographs" / name, poses[name]) for name in f.names]
    radius = json.loads((words.run / "run.json").read_text())["blending"]["weights"]["low_radius"]
    sees = np.stack([w for _, w in f.single], -1) > 0
    edge, _ = edge_distance(f.points)
    away = (edge > 8) & ~uneven_light(words.scene, words.run, f.points, sees, f.names)
    print(f"radius of the highest band's mean {radius:.4g}; each further one twice as wide\n")
    print("| split | bands | error, % | seam | away from edges | sharpness | lowest bands apart, % | split, s |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, mean in (("surface", surface_mean), ("pyramid", pyramid_mean)):
        splits, seconds = [[] for _ in photographs], []
        for b in range(2):
            began = time.process_time()
            for k, p in enumerate(photographs):
                splits[k].append(mean(p, radius * 2**b))
            seconds.append(time.process_time() - began)
            albedo, seen, apart = blended(f, photographs, poses, splits, b + 2)
            two = seen & (sees.sum(1) >= 2)
            i, j = neighbours(f.points, np.nonzero(seen)[0])
            far = away[i] & away[j]
            k, m = neighbours(f.points, np.nonzero(two)[0])
            print(f"| {name} | {b + 2} | {mean_median(relative(albedo[two], f.truth[two]))} | {seam(albedo, f.truth, sees, i, j):.3f} | {seam(albedo, f.truth, sees, i[far], j[far]):.3f} | "
                  f"{sharpness(albedo, f.truth, k, m):.4f} | {apart:.3f} | {sum(seconds):.1f} |", flush=True)


if __name__ == "__main__":
    main()
