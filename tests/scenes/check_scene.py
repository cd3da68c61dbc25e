#!/usr/bin/env python3
"""Checks a rendered scene folder against closed formulas, from its files alone: nothing here shares code with what wrote them.

    python tests/scenes/check_scene.py FOLDER …

For each photograph with a direct share: points of the cloud are projected by the COLMAP cameras; where the depth image says that a point is seen
and the flash reaches it, its albedo / pi * I cos / r^2 has to be the direct share of its pixel (mean of the channels). Points whose surroundings are
uneven are left out, as a pixel is a mean. Then the photograph minus its shares has to be noise of the size that project.toml states. On glossy
scenes (truth/material.npy) the formula is that of a rough dielectric over a diffuse body, see class Glossy.
"""
import json
import re
import sys
from pathlib import Path

import numpy as np
import mitsuba as mi

if mi.variant() is None:    # pictures are read alike by all of them
    mi.set_variant("scalar_rgb")

MEDIAN_TOLERANCE = 0.01     # of the median ratio; cosines of flat triangles and the patchy albedo leave a few tenths of a per cent
SHIFT_TOLERANCE = 0.25      # pixels
NOISE_RANGE = (0.95, 1.05)  # standard deviation found over stated; the shares hold the renderer's own noise too, so that cancels


def read_exr(path):
    return np.array(mi.Bitmap(str(path))).astype(np.float64)


def read_ply(path):
    raw = path.read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    number = int(re.search(rb"element vertex (\d+)", raw).group(1))
    columns = raw[:end].count(b"property float")
    return np.frombuffer(raw, "<f4", number * columns, end).reshape(number, columns).astype(np.float64)


def read_cameras(folder):
    line = [l for l in (folder / "cameras.txt").read_text().splitlines() if not l.startswith("#")][0].split()
    size, (fx, fy, cx, cy) = (int(line[2]), int(line[3])), map(float, line[4:8])
    found = {}
    for l in (folder / "images.txt").read_text().splitlines():
        if l.startswith("#") or not l.strip():
            continue
        f = l.split()
        w, x, y, z = map(float, f[1:5])
        r = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
        found[Path(f[9]).stem] = (r, np.array(list(map(float, f[5:8]))))
    return size, (fx, fy, cx, cy), found


class Glossy:
    """A diffuse body under a rough dielectric: GGX with Smith's separable shadowing (Walter et al., EGSR 2007), refractive index ETA.

    reflectance = F D G / (4 cos_in cos_out) + albedo / pi * T(in) T(out) / T(0)^2, T(x) = the share of light from x that
    passes the interface in one scattering: the albedo is that of light and view along the normal.
    """
    ETA = 1.49 / 1.000277

    def __init__(self, alpha):
        self.alpha = alpha
        self.cosines = np.linspace(0.01, 1, 60)
        self.through = np.array([self.transmitted(c) for c in self.cosines])

    def fresnel(self, c):
        g = np.sqrt(self.ETA ** 2 - 1 + c * c)
        return 0.5 * ((g - c) / (g + c)) ** 2 * (1 + ((c * (g + c) - 1) / (c * (g - c) + 1)) ** 2)

    def d(self, c):
        return self.alpha ** 2 / (np.pi * (c * c * (self.alpha ** 2 - 1) + 1) ** 2)

    def g1(self, c):
        return 2 / (1 + np.sqrt(1 + self.alpha ** 2 * (1 / np.maximum(c, 1e-6) ** 2 - 1)))

    def transmitted(self, cos_in):
        """The share that passes the interface in one scattering: an integral over microfacet normals m, weighted as visible from outside."""
        u, phi = (np.arange(400) + 0.5) / 400, (np.arange(120) + 0.5) / 120 * np.pi
        z, dz = 1 - (1 - u) ** 2, 2 * (1 - u) / 400         # denser towards the pole
        s = np.sqrt(1 - z * z)
        in_m = np.maximum(cos_in * z[:, None] + np.sqrt(1 - cos_in ** 2) * s[:, None] * np.cos(phi), 0)
        inner_m = np.sqrt(1 - (1 - in_m ** 2) / self.ETA ** 2)
        down = cos_in / self.ETA - (in_m / self.ETA - inner_m) * z[:, None]      # cosine of the refracted direction below the surface
        f = (1 - self.fresnel(in_m)) * self.d(z)[:, None] * self.g1(cos_in) * self.g1(np.maximum(down, 0)) * in_m / cos_in
        return np.sum(np.where((in_m > 0) & (down > 0), f, 0) * dz[:, None]) * 2 * np.pi / 120

    def __call__(self, albedo, cos_in, cos_out, cos_half, in_half):
        through = np.interp(cos_in, self.cosines, self.through) * np.interp(cos_out, self.cosines, self.through) / self.through[-1] ** 2
        gloss = self.fresnel(in_half) * self.d(cos_half) * self.g1(cos_in) * self.g1(cos_out) / (4 * np.maximum(cos_in * cos_out, 1e-6))
        return gloss + albedo / np.pi * through


def predicted(points, normals, albedo, r, t, offset, intensity, surfaces):
    """Mean over channels of the radiance under the flash alone, unoccluded. surfaces: [(Glossy or None, chosen points)]."""
    to_flash, to_eye = r.T @ (offset - t) - points, -r.T @ t - points
    distance = np.linalg.norm(to_flash, axis=1)
    to_flash, to_eye = to_flash / distance[:, None], to_eye / np.linalg.norm(to_eye, axis=1)[:, None]
    half = to_flash + to_eye
    half /= np.linalg.norm(half, axis=1)[:, None]
    cos_in, cos_out, cos_half = (np.maximum(np.einsum("ij,ij->i", normals, v), 0) for v in (to_flash, to_eye, half))
    reflectance = albedo.mean(axis=1) / np.pi
    for glossy, chosen in surfaces:
        if glossy:
            in_half = np.einsum("ij,ij->i", to_flash, half)
            reflectance[chosen] = glossy(albedo.mean(axis=1)[chosen], cos_in[chosen], cos_out[chosen], cos_half[chosen], in_half[chosen])
    return reflectance * intensity * cos_in / distance ** 2


def spread_of_pixels(image, pixel_y, pixel_x):
    """Relative range of a 3 x 3 neighbourhood."""
    low, high = np.full(len(pixel_x), np.inf), np.full(len(pixel_x), -np.inf)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            v = image[pixel_y + dy, pixel_x + dx]
            low, high = np.minimum(low, v), np.maximum(high, v)
    return (high - low) / np.maximum(high, 1e-9)


def ratio_at(direct, image_of_points, x, y, wanted):
    """ln of measured over predicted, per point, the image read bilinearly at (x, y) in pixel coordinates (centres at +0.5)."""
    fx, fy = x - 0.5, y - 0.5
    ix, iy = np.floor(fx).astype(int), np.floor(fy).astype(int)
    u, v = fx - ix, fy - iy
    value = (direct[iy, ix] * (1 - u) * (1 - v) + direct[iy, ix + 1] * u * (1 - v) + direct[iy + 1, ix] * (1 - u) * v + direct[iy + 1, ix + 1] * u * v)
    return np.log(np.maximum(value, 1e-9) / image_of_points)[wanted]


def best_shift(direct, radiance, x, y, wanted):
    """Shift in pixels, per axis, that makes measured and predicted agree best: a parabola through the scatter at -1, 0, 1."""
    found = []
    for axis in (0, 1):
        scatter = []
        for s in (-1.0, 0.0, 1.0):
            d = ratio_at(direct, radiance, x + (s if axis == 0 else 0), y + (s if axis == 1 else 0), wanted)
            d = d[np.abs(d) < 0.7]
            scatter.append(np.mean((d - np.median(d)) ** 2))
        a, b, c = scatter
        found.append(0.5 * (a - c) / max(a - 2 * b + c, 1e-12))
    return found


def check_photograph(folder, name, cloud, normals, albedo, size, pinhole, pose, lights, offset, noise, surfaces):
    (w, h), (fx, fy, cx, cy), (r, t) = size, pinhole, pose
    q = cloud[:, :3] @ r.T + t
    front = q[:, 2] > 0.05
    x, y = np.where(front, fx * q[:, 0] / q[:, 2] + cx, -9), np.where(front, fy * q[:, 1] / q[:, 2] + cy, -9)
    share = read_exr(folder / "truth" / (name + "_share.exr"))
    depth = read_exr(folder / "truth" / (name + "_depth.exr")).reshape(h, w)
    mask = np.array(mi.Bitmap(str(folder / "masks" / (name + ".png")))).reshape(h, w) > 127
    inside = (x > 3) & (x < w - 3) & (y > 3) & (y < h - 3)
    px, py = np.where(inside, x, 5).astype(int), np.where(inside, y, 5).astype(int)
    distance = np.linalg.norm(q, axis=1)
    seen = inside & mask[py, px] & (np.abs(depth[py, px] / distance - 1) < 0.004) & (spread_of_pixels(depth, py, px) < 0.02)
    radiance = predicted(cloud[:, :3], normals, albedo, r, t, offset, lights["flash_intensity_w_per_sr"], surfaces)
    direct = share[:, :, 0]
    usable = seen & (radiance > 0.02 * np.median(radiance[seen]))
    even = usable & (spread_of_pixels(direct, py, px) < 0.25)
    ratio = np.exp(ratio_at(direct, np.maximum(radiance, 1e-9), np.where(inside, x, 5), np.where(inside, y, 5), even))
    lit = ratio[ratio > 0.5]
    centre = np.median(lit)
    shift = best_shift(direct, np.maximum(radiance, 1e-9), np.where(inside, x, 5), np.where(inside, y, 5), usable)
    photo = read_exr(folder / "photos" / (name + ".exr"))[:, :, :3]
    clean = share.sum(axis=2)
    residual = (photo.mean(axis=2) - clean)[mask]
    stated = np.sqrt((noise["gain"] * photo.mean(axis=2)[mask].clip(0) + noise["read_sigma"] ** 2) / 3)
    z = residual / stated
    spread = 1.4826 * np.median(np.abs(z - np.median(z)))
    good = abs(centre - 1) < MEDIAN_TOLERANCE and max(map(abs, shift)) < SHIFT_TOLERANCE and NOISE_RANGE[0] < spread < NOISE_RANGE[1] and len(lit) > 500
    print("%s %s: %d points lit, %.0f %% in shadow, direct over closed form %.4f (spread %.3f), shift %+.2f %+.2f px, noise over stated %.2f, mean residual %+.2f sd  %s" %
          (folder.name, name, len(lit), 100 * np.mean(ratio < 0.05), centre, 1.4826 * np.median(np.abs(lit - np.median(lit))), *shift, spread, np.median(z), "ok" if good else "WRONG"))
    return good


def check(folder):
    project = (folder / "project.toml").read_text()
    offset = np.array(list(map(float, re.search(r"offset_in_camera = \[(.*)\]", project).group(1).split(","))))
    low, high = map(float, re.search(r"intensity_range  = \[(.*)\]", project).group(1).split(","))
    noise = dict(gain=float(re.search(r"gain = ([\d.e-]+)", project).group(1)), read_sigma=float(re.search(r"read_sigma = ([\d.e-]+)", project).group(1)))
    lights = json.loads((folder / "truth/lights.json").read_text())
    cloud = read_ply(folder / "cloud.ply")
    albedo = np.load(folder / "truth/albedo.npy").astype(float)
    normals = np.load(folder / "truth/normal.npy").astype(float) if (folder / "truth/normal.npy").exists() else cloud[:, 3:6]
    material = np.load(folder / "truth/material.npy") if (folder / "truth/material.npy").exists() else np.zeros(len(cloud), int)
    surfaces = [(Glossy(alpha) if alpha else None, material == m) for m, alpha in enumerate(lights.get("roughness", [0]))]
    size, pinhole, poses = read_cameras(folder / "sparse")
    position = (lights["flash_intensity_w_per_sr"] - low) / (high - low)
    good = 0.05 < position < 0.95 and abs(position - 0.5) > 0.02 and len(albedo) == len(cloud)
    print("%s: flash interval %.3g..%.3g, the truth at %.2f of it" % (folder.name, low, high, position))
    for name, pose in sorted(poses.items()):
        if (folder / "truth" / (name + "_share.exr")).exists():
            good &= check_photograph(folder, name, cloud, normals, albedo, size, pinhole, pose, lights, offset, noise, surfaces)
    return good


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    results = [check(Path(f)) for f in sys.argv[1:]]
    sys.exit(0 if all(results) else 1)
