#!/usr/bin/env python3
"""Where the seam energy of blend_figures.py lies, and how much of it blending adds.

usage: python3 tests/bench/blend_seams.py SCENE RUN      (needs numpy, scipy, blosc from PyPI; SCENE and RUN as for blend_figures.py)

A step is the difference of the log error between two neighbouring points; across: between points that different photographs saw. Rows, all "across over inside":
  plain        as blend_figures.py has it
  places       the same for single photographs: both points of a step are read in one photograph, no blending takes part. What borders lie at
  blending     plain / places: what is left for blending
  standardised steps across against steps inside of the same kind: as many photographs in common (1, 2, 3, 4 and more), as far from an edge of the geometry
               (0 to 2, 4, 8, 16 spacings and farther), as near to an edge of a cast shadow (light uneven in a pixel of any photograph that sees it) or not
  away         only steps farther than 8 spacings from edges of the geometry and not beside a cast shadow's edge
Then the steps by kind: how many lie across, which part of the energy across they make up, mean step of the blend (per cent) across and inside, and that of single photographs.
"""
import numpy as np
from scipy.spatial import cKDTree

from blend_figures import Figures, cameras, log_error, neighbours, raster, scene_and_run

FAR = (2, 4, 8, 16)
UNEVEN = 0.03   # standard deviation over mean of the flash's irradiance in a pixel
BUMPY = 0.12     # of the radius of the surroundings: a fold of 50 degrees through the middle


def edge_distance(points):
    """From the nearest point whose surroundings (24 points) are not flat, or that lies at an end of the surface; in spacings, at most 32."""
    tree = cKDTree(points)
    spacing = np.median(tree.query(points, 2, workers=-1)[0][:, 1])
    edges = np.zeros(len(points), bool)
    for at in range(0, len(points), 1 << 16):
        own = slice(at, at + (1 << 16))
        around = points[tree.query(points[own], 25, workers=-1)[1]]
        offset = around - around.mean(1, keepdims=True)
        spread, axes = np.linalg.eigh(np.einsum("nik,nil->nkl", offset, offset) / 25)
        radius = np.linalg.norm(around - points[own, None], axis=2).max(1)
        edges[own] = (np.sqrt(spread[:, 0]) > BUMPY * radius) | (np.linalg.norm(around.mean(1) - points[own], axis=1) > 0.35 * radius)
    return np.minimum(32, cKDTree(points[edges]).query(points, distance_upper_bound=32 * spacing, workers=-1)[0] / spacing), np.mean(edges)


def uneven_light(scene, run, points, seen, names):
    """Whether a photograph that sees a point has uneven light in its pixel or one beside it."""
    result = np.zeros(len(points), bool)
    poses = cameras(scene / "sparse")
    for k, name in enumerate(names):
        planes = raster(run / "work/photographs" / name / "gbuffer.raster", {"spread"})
        if "spread" not in planes:
            continue
        spread = np.nan_to_num(planes["spread"])
        wide = spread.copy()
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                wide = np.maximum(wide, np.roll(spread, (dy, dx), (0, 1)))
        rotation, translation, (fx, fy, cx, cy) = poses[name]
        own = np.nonzero(seen[:, k])[0]
        local = points[own] @ rotation.T + translation
        x, y = (fx * local[:, 0] / local[:, 2] + cx).astype(int), (fy * local[:, 1] / local[:, 2] + cy).astype(int)
        result[own] |= wide[y, x] > UNEVEN
    return result


def ratio(step, across, chosen=slice(None)):
    step, across = step[chosen], across[chosen]
    return np.mean(step[across]) / np.mean(step[~across])


def main():
    words = scene_and_run(__doc__).parse_args()
    f = Figures(words.scene, words.run)
    weights, mean, best = f.plain()
    sees, seen = weights > 0, (f.photos > 0) & (weights > 0).any(1)
    i, j = neighbours(f.points, np.nonzero(seen)[0])
    across = (sees[i] != sees[j]).any(1)
    common = (sees[i] & sees[j]).sum(1)
    i, j, across, common = (v[common > 0] for v in (i, j, across, common))
    from_edge, share = edge_distance(f.points)
    edge = np.minimum(from_edge[i], from_edge[j])
    uneven = uneven_light(words.scene, words.run, f.points, sees, f.names)
    shadow = uneven[i] | uneven[j]
    singles, count = np.zeros(len(i)), np.zeros(len(i))
    for k, (albedo, _) in enumerate(f.single):
        both = sees[i, k] & sees[j, k]
        error = np.full(len(f.points), np.nan)
        own = sees[:, k]
        error[own] = log_error(albedo[own], f.truth[own])
        singles[both] += np.abs(error[i[both]] - error[j[both]])
        count[both] += 1
    singles /= count
    kind = np.minimum(common, 4) * 100 + np.searchsorted(FAR, edge) * 10 + shadow
    steps = {}
    for name, albedo in (("chiaro", f.blend), ("weighted mean", mean), ("best photograph", best)):
        error = np.zeros(len(f.points))
        error[seen] = log_error(albedo[seen], f.truth[seen])
        steps[name] = np.abs(error[i] - error[j])
    places = ratio(singles, across)
    away = (edge > 8) & ~shadow
    print(f"{len(i)} steps, {across.sum()} across; {away.sum()} and {(away & across).sum()} away from edges; {100 * share:.1f} % of the points are edges; {100 * shadow.mean():.1f} % of the steps beside a shadow's\n")
    print("| | plain | places | blending | standardised | away | singles, away |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, step in steps.items():
        expected = np.zeros(len(step))
        known = np.ones(len(step), bool)
        for one in np.unique(kind):
            inside = (kind == one) & ~across
            if inside.sum() < 30:
                known &= kind != one
            else:
                expected[kind == one] = np.mean(step[inside])
        standardised = np.mean(step[across & known]) / np.mean(expected[across & known])
        print(f"| {name} | {ratio(step, across):.3f} | {places:.3f} | {ratio(step, across) / places:.3f} | {standardised:.3f} | {ratio(step, across, away):.3f} | {ratio(singles, across, away):.3f} |")
    step = steps["chiaro"]
    excess = step[across].sum()
    print("\n| kind of step | across | of all steps there | of the energy across | blend across / inside, % | singles across / inside, % |\n| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, chosen in (("within 2 spacings of an edge of the geometry", edge <= 2), ("2 to 8", (edge > 2) & (edge <= 8)), ("farther", edge > 8), ("beside a cast shadow's edge", shadow),
                         ("farther than 8 and not beside one", away), ("one photograph in common", common == 1), ("two", common == 2), ("three or more", common >= 3)):
        a, n = chosen & across, chosen & ~across
        print(f"| {name} | {a.sum()} | {100 * a.sum() / chosen.sum():.1f} % | {100 * step[a].sum() / excess:.0f} % | {100 * step[a].mean():.2f} / {100 * step[n].mean():.2f} | "
              f"{100 * singles[a].mean():.2f} / {100 * singles[n].mean():.2f} |")


if __name__ == "__main__":
    main()
