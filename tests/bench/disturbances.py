"""What goes wrong with real acquisitions, done to a copy of a rendered scene by a known amount. Each function takes the scene, its copy (scene_copy.link_scene) and a level."""
import re

import numpy as np
from scipy.spatial.transform import Rotation

import scene_copy

SEED = 20
OFFSET_DIRECTION = np.array([0.6, 0.53, 0.6]) / np.linalg.norm([0.6, 0.53, 0.6])   # right, down and forward


def photographs_of(scene):
    return sorted((scene / "photos").glob("photo_??.exr"))


def edit_project(copy, change):
    """Applies change(text) to each project file of the copy."""
    for file in copy.glob("project*.toml"):
        scene_copy.write_text(file, change(file.read_text()))


def edit_list(text, key, change):
    """`key = [a, b, …]` with its numbers changed."""
    def edited(match):
        return "%s[%s]" % (match.group(1), ", ".join("%.9g" % v for v in change(np.array([float(v) for v in match.group(2).split(",")]))))
    return re.sub(r"(?m)^(\s*%s\s*=\s*)\[([^\]]*)\]" % key, edited, text)


def tangents(normals):
    """Two unit vectors across each normal."""
    other = np.where(np.abs(normals[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normals, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)


def turned(normals, a, b):
    """Normals turned by the angles a and b (radians) about the two axes across them."""
    first, second = tangents(normals)
    new = normals + np.tan(a)[:, None] * first + np.tan(b)[:, None] * second
    return new / np.linalg.norm(new, axis=1, keepdims=True)


def cloud_and_normals(scene):
    points, normals = scene_copy.read_cloud(scene / "cloud.ply")
    if normals is None:
        normals = np.load(scene / "truth/normal.npy").astype(np.float64)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def normals_each(scene, copy, degrees):
    """The normal of each point turned by itself: rms angle `degrees`."""
    points, normals = cloud_and_normals(scene)
    angles = np.radians(degrees) / np.sqrt(2) * np.random.default_rng(SEED).normal(size=(2, len(points)))
    scene_copy.write_cloud(copy / "cloud.ply", points, turned(normals, *angles))


def normals_together(scene, copy, degrees):
    """Normals turned alike over regions: a sum of waves of an eighth of the scene's size, rms angle `degrees`."""
    points, normals = cloud_and_normals(scene)
    rng = np.random.default_rng(SEED)
    size = np.linalg.norm(points.max(0) - points.min(0))
    angles = np.zeros((2, len(points)))
    for k in range(2):
        for _ in range(24):
            direction = rng.normal(size=3)
            wave = 2 * np.pi * 8 / size * direction / np.linalg.norm(direction)
            angles[k] += np.sin(points @ wave + rng.uniform(0, 2 * np.pi))
    angles *= np.radians(degrees) / np.sqrt(np.mean(np.sum(angles**2, 0)))
    scene_copy.write_cloud(copy / "cloud.ply", points, turned(normals, *angles))


def registration(scene, copy, pixels):
    """Every camera turned so that its image moves by `pixels`, each in a direction of its own."""
    rng = np.random.default_rng(SEED)
    focal = float([l for l in (scene / "sparse/cameras.txt").read_text().splitlines() if not l.startswith("#")][0].split()[4])
    lines = []
    for line in (scene / "sparse/images.txt").read_text().splitlines():
        words = line.split()
        if len(words) == 10 and not line.startswith("#"):
            way = rng.uniform(0, 2 * np.pi)
            turn = Rotation.from_rotvec(np.arctan(pixels / focal) * np.array([np.cos(way), np.sin(way), 0]))
            w, x, y, z = map(float, words[1:5])
            q = (turn * Rotation.from_quat([x, y, z, w])).as_quat()
            t = turn.apply([float(v) for v in words[5:8]])
            line = " ".join([words[0], *("%.12g" % v for v in (q[3], *q[:3], *t)), *words[8:]])
        lines.append(line)
    scene_copy.write_text(copy / "sparse/images.txt", "\n".join(lines) + "\n")


def flash_offset(scene, copy, centimetres):
    """The project file says that the flash is elsewhere; scenes are in metres."""
    edit_project(copy, lambda text: edit_list(text, "offset_in_camera", lambda v: v + centimetres / 100 * OFFSET_DIRECTION))


def read_noise(scene, copy, times):
    """Photographs with more read noise; the project file says so."""
    rng = np.random.default_rng(SEED)
    sigma = float(re.search(r"read_sigma = ([\d.e+-]+)", (scene / "project.toml").read_text()).group(1))
    for photo in photographs_of(scene):
        picture = scene_copy.read_exr(photo)
        scene_copy.write_exr(copy / "photos" / photo.name, picture + sigma * np.sqrt(times**2 - 1) * rng.normal(size=picture.shape))
    edit_project(copy, lambda text: re.sub(r"read_sigma = [\d.e+-]+", "read_sigma = %.9g" % (sigma * times), text))


def interval(scene, copy, times):
    """The calibrated range of the flash, a factor off."""
    edit_project(copy, lambda text: edit_list(text, "intensity_range", lambda v: v * times))


def ambient(scene, copy, times):
    """The first photograph under more ambient light. Its part of each pixel is known in grey; its colour is taken as the pixel's."""
    photo = photographs_of(scene)[0]
    picture = scene_copy.read_exr(photo)
    share = scene_copy.read_exr(scene / "truth" / (photo.stem + "_share.exr"))
    part = share[..., 2:] / np.maximum(share.sum(-1, keepdims=True), 1e-6)
    scene_copy.write_exr(copy / "photos" / photo.name, picture * (1 + (times - 1) * part))


def overexposed(scene, copy, times):
    """The first photograph brighter by a factor, and clipped at the brightest value that it had: a file of floats does not say where white is."""
    photo = photographs_of(scene)[0]
    picture = scene_copy.read_exr(photo)
    scene_copy.write_exr(copy / "photos" / photo.name, np.minimum(picture * times, np.quantile(picture, 0.9999)))


# name: (what is done, unit, levels, level that changes nothing)
ALL = {
    "normals_each": (normals_each, "degrees, each normal by itself", [1, 2, 5], 0),
    "normals_together": (normals_together, "degrees, normals alike over regions", [1, 2, 5], 0),
    "registration": (registration, "px, each photograph its own way", [0.5, 1, 2], 0),
    "flash_offset": (flash_offset, "cm, flash beside where it is said to be", [1, 2, 3], 0),
    "read_noise": (read_noise, "times the read noise, declared", [3, 10], 1),
    "interval": (interval, "times the calibrated range", [1 / 1.2, 1 / 1.1, 1.1, 1.2], 1),
    "ambient": (ambient, "times the ambient light, first photograph", [1.5, 2], 1),
    "overexposed": (overexposed, "times the exposure, first photograph, clipped", [2, 4], 1),
}
