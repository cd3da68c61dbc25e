#!/usr/bin/env python3
"""What blending does to the albedo of single photographs: error, seams, sharpness, coverage, beside the plain weighted mean and the best photograph.

usage: python3 tests/bench/blend_figures.py SCENE RUN [--band Z0 Z1]      (needs numpy, scipy, blosc from PyPI)
SCENE: a rendered scene with cloud.ply, sparse/ (COLMAP text, PINHOLE) and truth/albedo.npy. RUN: the folder of a finished `chiaro run` of it.

Single photographs are read at the points bilinearly, from the run's own working images, where the point lies on the surface that the pixel sees.
  error      |a - truth| / truth, mean of the channels, per cent, mean / median over points. Each photograph is set against the blend on the same points.
  mean, best the same photographs blended plainly: weights cos^2 / footprint^2, and the reading of the largest weight
  seam       mean step of the log error between neighbouring points that different photographs saw, over that between points that the same ones saw.
             Borders between photographs lie where surfaces and shadows have theirs: "single photographs" shows what that alone amounts to, as both points
             of a step are then of one photograph and no blending takes part
  sharpness  how much of truth's steps between neighbouring points is there (slope of steps against truth's), points seen by two photographs or more
  edges      with --band: of the upright edges between two paints in a band of walls that stand along x or y. They are found in the truth. All points
             within 3 cm of them, by their distance, make up one edge that is sampled far finer than the points lie; an error function is fitted to it.
             MTF50: the frequency, in periods a unit of length, at which that edge keeps half of its contrast. The truth's own edges are soft too (paint ends
             over some millimetres, and where an edge lies is known to about half of one): its row says how much of the width that is
"""
import argparse
from pathlib import Path

import blosc
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.special import erf

TYPES = {0: "<f4", 1: "<u4", 2: "<u2", 3: "u1"}


def raster(path, wanted):
    data = path.read_bytes()
    _, width, height, count, rows, _, index = np.frombuffer(data[8:40], "<u4,<i4,<i4,<u4,<u4,<u4,<u8")[0].item()
    blocks = -(-height // rows)
    entries = np.frombuffer(data[index:], "<u8,<u4,<u4").reshape(count, blocks)
    planes = {}
    for k in range(count):
        record = data[40 + 40 * k : 80 + 40 * k]
        name, kind = record[:32].rstrip(b"\0").decode(), np.dtype(TYPES[int.from_bytes(record[32:36], "little")])
        if name in wanted:
            planes[name] = np.frombuffer(b"".join(blosc.decompress(data[at : at + size]) for at, size, _ in entries[k].tolist()), kind).reshape(height, width)
    return planes


def ply(path):
    data = path.read_bytes()
    start = data.index(b"end_header\n") + 11
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2", "int": "<i4", "uint": "<u4", "short": "<i2", "char": "i1"}
    fields = [line.split()[1:] for line in data[:start].decode().splitlines() if line.startswith("property ")]
    return np.frombuffer(data[start:], np.dtype([(name, kinds[kind]) for kind, name in fields]))


def cameras(folder):
    lenses = {}
    for line in (folder / "cameras.txt").read_text().splitlines():
        if line and line[0] != "#":
            words = line.split()
            lenses[words[0]] = [float(v) for v in words[4:]]
    result = {}
    lines = [line for line in (folder / "images.txt").read_text().splitlines() if not line.startswith("#")]
    for line in lines[::2]:
        words = line.split()
        if len(words) < 10:
            continue
        w, x, y, z = (float(v) for v in words[1:5])
        rotation = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                             [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
        result[Path(words[9]).stem] = (rotation, np.array([float(v) for v in words[5:8]]), lenses[words[8]])
    return result


def bilinear(planes, px, py):
    x0, y0 = np.floor(px).astype(int), np.floor(py).astype(int)
    fx, fy = (px - x0)[:, None], (py - y0)[:, None]
    return (1 - fy) * ((1 - fx) * planes[y0, x0] + fx * planes[y0, x0 + 1]) + fy * ((1 - fx) * planes[y0 + 1, x0] + fx * planes[y0 + 1, x0 + 1])


def read_photograph(folder, camera, points):
    """Albedo per point (NaN: not seen) and the plain weight."""
    g = raster(folder / "gbuffer.raster", {"depth", "cosv", "footprint", "radius", "edge"})
    a = raster(folder / "albedo.raster", {"r", "g", "b"})
    height, width = g["depth"].shape
    rotation, translation, (fx, fy, cx, cy) = camera
    local = points @ rotation.T + translation
    distance = np.linalg.norm(local, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        px, py = fx * local[:, 0] / local[:, 2] + cx - 0.5, fy * local[:, 1] / local[:, 2] + cy - 0.5
    inside = np.nonzero((local[:, 2] > 0) & (px >= 1) & (px < width - 2) & (py >= 1) & (py < height - 2))[0]
    x, y = np.rint(px[inside]).astype(int), np.rint(py[inside]).astype(int)
    depth, cosv, footprint, edge = (g[name][y, x].astype(float) for name in ("depth", "cosv", "footprint", "edge"))
    slope = np.sqrt(np.maximum(0, 1 - cosv**2)) / np.maximum(cosv, 0.05)
    seen = (depth > 0) & (cosv > 0.19) & (edge > 1) & (np.abs(distance[inside] - depth) <= 0.6 * g["radius"][y, x] + footprint * (0.5 + slope))
    inside = inside[seen]
    albedo = np.full((len(points), 3), np.nan)
    albedo[inside] = bilinear(np.stack([a[c] for c in "rgb"], -1).astype(float), px[inside], py[inside])
    weight = np.zeros(len(points))
    weight[inside] = cosv[seen] ** 2 / footprint[seen] ** 2
    weight[~np.isfinite(albedo).all(1)] = 0
    return albedo, weight


def relative(albedo, truth):
    return np.mean(np.abs(albedo - truth) / truth, axis=1)


def mean_median(error):
    return f"{100 * np.mean(error):.3f} / {100 * np.median(error):.3f}"


def neighbours(points, chosen):
    """Pairs of chosen points that are near each other, each with its few nearest."""
    tree = cKDTree(points[chosen])
    distance, index = tree.query(points[chosen], 5, workers=-1)
    near = distance[:, 1:] < 2 * np.median(distance[:, 1])
    i = np.repeat(np.arange(len(chosen)), 4)[near.ravel()]
    j = index[:, 1:].ravel()[near.ravel()]
    return chosen[i], chosen[j]


def log_error(albedo, truth):
    return np.log(np.maximum(albedo, 1e-4) / truth).mean(1)


def seam(albedo, truth, sees, i, j):
    error = log_error(albedo, truth)
    step = np.abs(error[i] - error[j])
    across = (sees[i] != sees[j]).any(1)
    return np.mean(step[across]) / np.mean(step[~across])


def seam_of_singles(single, truth, sees, i, j):
    across = (sees[i] != sees[j]).any(1)
    steps = [[], []]
    for k, (albedo, _) in enumerate(single):
        both = sees[i, k] & sees[j, k]
        error = log_error(albedo, truth)
        for side in (0, 1):
            chosen = both & (across == bool(side))
            steps[side].append(np.abs(error[i[chosen]] - error[j[chosen]]))
    return np.mean(np.concatenate(steps[1])) / np.mean(np.concatenate(steps[0]))


def sharpness(albedo, truth, i, j):
    steps, true = albedo[i] - albedo[j], truth[i] - truth[j]
    return np.sum(steps * true) / np.sum(true * true)


REACH = 0.03   # on both sides of an edge


def edges_of_band(points, truth, normals, chosen):
    """Indices of the points beside the upright edges between bright and dark paint, and their distances from these, positive on the bright side."""
    index, distance = [], []
    for axis in (0, 1):
        wall = chosen & (np.abs(normals[:, axis]) > 0.97)
        if wall.sum() < 100:
            continue
        wall &= np.abs(points[:, axis] - np.median(points[wall, axis])) < 0.03
        own = np.nonzero(wall)[0]
        along, green = points[own, 1 - axis], truth[own, 1]
        bright = green > (np.quantile(green, 0.1) + np.quantile(green, 0.9)) / 2
        places = np.arange(along.min() + REACH, along.max() - REACH, 3e-4)
        for rises in (True, False):
            wrong = np.array([np.mean(((along[near] > p) == rises) != bright[near]) if (near := np.abs(along - p) < REACH).sum() > 25 else 1 for p in places])
            at = 0
            while at < len(places):
                if wrong[at] >= 0.12:
                    at += 1
                    continue
                end = np.searchsorted(places, places[at] + REACH)
                least = wrong[at:end].min()
                if least < 0.06:
                    place = np.mean(places[at:end][wrong[at:end] == least])
                    near = np.abs(along - place) < REACH
                    index.append(own[near])
                    distance.append((along[near] - place) * (1 if rises else -1))
                at = end
    return (np.concatenate(index), np.concatenate(distance), len(index)) if index else (np.zeros(0, int), np.zeros(0), 0)


def width_of_edges(albedo, index, distance):
    """Standard deviation of the blur of a step, same unit as the points."""
    value = albedo[index].mean(1)
    low, high = np.median(value[distance < -REACH / 2]), np.median(value[distance > REACH / 2])
    off = lambda q: 0.5 + 0.5 * erf((distance - q[1]) / (np.sqrt(2) * q[0])) - (value - low) / (high - low)
    return abs(least_squares(off, [0.1 * REACH, 0], loss="soft_l1", f_scale=0.1).x[0])


def mtf50(width):
    """Of a Gaussian of that width."""
    return np.sqrt(2 * np.log(2)) / (2 * np.pi * width)


def print_edges(f, mean, best, chosen):
    index, distance, count = edges_of_band(f.points, f.truth, np.load(f.scene / "truth/normal.npy").astype(float), chosen)
    if count == 0:
        return print("\nno upright edges between two paints in the band")
    truth, sharpest = width_of_edges(f.truth, index, distance), width_of_edges(best, index, distance)
    print(f"\n{count} edges, {len(index)} points\n\n| edges of the band | width (sd), mm | MTF50, 1/m | of the best photograph's | blur besides the truth's own (sd), mm |\n| --- | ---: | ---: | ---: | ---: |")
    for name, albedo in (("truth", f.truth), ("chiaro", f.blend), ("weighted mean", mean), ("best photograph", best)):
        width = width_of_edges(albedo, index, distance)
        print(f"| {name} | {1000 * width:.2f} | {mtf50(width):.1f} | {sharpest / width:.3f} | {1000 * np.sqrt(max(0, width**2 - truth**2)):.2f} |")


class Figures:
    def __init__(self, scene, run):
        self.scene = scene
        points = ply(scene / "cloud.ply")
        self.points = np.stack([points[c] for c in "xyz"], -1).astype(float)
        self.truth = np.load(scene / "truth/albedo.npy").astype(float)
        result = ply(run / "albedo.ply")
        self.blend = np.stack([result["albedo_" + c] for c in "rgb"], -1).astype(float)
        self.photos = result["photos"]
        lenses = cameras(scene / "sparse")
        self.names = sorted(p.name for p in (run / "work/photographs").iterdir())
        self.single = [read_photograph(run / "work/photographs" / name, lenses[name], self.points) for name in self.names]

    def plain(self):
        weights = np.stack([w for _, w in self.single], -1)
        values = np.nan_to_num(np.stack([a for a, _ in self.single], 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = (values * weights[..., None]).sum(1) / weights.sum(1)[:, None]
        best = np.take_along_axis(values, weights.argmax(1)[:, None, None], 1)[:, 0]
        return weights, mean, best

    def error(self):
        seen = self.photos > 0
        return relative(self.blend[seen], self.truth[seen])


def scene_and_run(description):
    """A parser of the two folders that all of these take."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("run", type=Path)
    return parser


def main():
    parser = scene_and_run(__doc__)
    parser.add_argument("--band", type=float, nargs=2, help="height of the painted band, for sharpness")
    words = parser.parse_args()
    f = Figures(words.scene, words.run)
    weights, mean, best = f.plain()
    sees, seen = weights > 0, (f.photos > 0) & (weights > 0).any(1)
    print(f"seen {100 * np.mean(f.photos > 0):.2f} % of {len(f.points)} points; error, %: {mean_median(f.error())}")
    print("\n| photograph | points | its error, % | blend on the same points, % |\n| --- | ---: | ---: | ---: |")
    singles = []
    for k, name in enumerate(f.names):
        own = sees[:, k] & seen
        if own.any():
            singles.append((np.mean(relative(f.single[k][0][own], f.truth[own])), np.mean(relative(f.blend[own], f.truth[own]))))
            print(f"| {name} | {own.sum()} | {mean_median(relative(f.single[k][0][own], f.truth[own]))} | {mean_median(relative(f.blend[own], f.truth[own]))} |")
    singles = np.array(singles)
    print(f"\nblend / photograph on the same points: {np.mean(singles[:, 1]) / np.mean(singles[:, 0]):.3f} on the mean, {np.max(singles[:, 1] / singles[:, 0]):.3f} at worst")
    overlap = seen & (sees.sum(1) >= 2)
    i, j = neighbours(f.points, np.nonzero(seen)[0])
    k, m = neighbours(f.points, np.nonzero(overlap)[0])
    height = f.points[:, 2]
    banded = None if words.band is None else (height[k] >= words.band[0]) & (height[k] <= words.band[1]) & (height[m] >= words.band[0]) & (height[m] <= words.band[1])
    print("\n| | error, seen by 2 or more, % | seam | sharpness |" + (" sharpness, band |" if banded is not None else ""))
    print("| --- | ---: | ---: | ---: |" + (" ---: |" if banded is not None else ""))
    for name, albedo in (("chiaro", f.blend), ("weighted mean", mean), ("best photograph", best)):
        row = f"| {name} | {mean_median(relative(albedo[overlap], f.truth[overlap]))} | {seam(albedo, f.truth, sees, i, j):.3f} | {sharpness(albedo, f.truth, k, m):.4f} |"
        print(row + (f" {sharpness(albedo, f.truth, k[banded], m[banded]):.4f} |" if banded is not None else ""))
    print(f"| single photographs | | {seam_of_singles(f.single, f.truth, sees, i, j):.3f} | |" + (" |" if banded is not None else ""))
    if words.band is not None:
        print_edges(f, mean, best, overlap & (height >= words.band[0]) & (height <= words.band[1]))
    print(f"\npoints by number of photographs that see them: {np.bincount(sees.sum(1))[1:].tolist()}")


if __name__ == "__main__":
    main()
