"""What goes wrong with real acquisitions, done to a copy of a rendered scene by a known amount. Each function takes the scene, its copy (scene_copy.link_scene) and a level."""
import re

import numpy as np
from scipy.ndimage import convolve
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


def ambient_each(scene, copy, sd):
    """Each photograph under more or less ambient light, as daylight under passing clouds: ln of the factor with that deviation, mean 0. Needs the shares of all photographs (tests/scenes writes them)."""
    photos = photographs_of(scene)
    ln = np.random.default_rng(SEED).normal(size=len(photos))
    ln = sd * (ln - ln.mean()) / ln.std()
    for photo, times in zip(photos, np.exp(ln)):
        share = scene_copy.read_exr(scene / "truth" / (photo.stem + "_share.exr"))
        part = share[..., 2:] / np.maximum(share.sum(-1, keepdims=True), 1e-6)
        scene_copy.write_exr(copy / "photos" / photo.name, scene_copy.read_exr(photo) * (1 + (times - 1) * part))


def overexposed(scene, copy, times):
    """The first photograph brighter by a factor, and clipped at the brightest value that it had: a file of floats does not say where white is."""
    photo = photographs_of(scene)[0]
    picture = scene_copy.read_exr(photo)
    scene_copy.write_exr(copy / "photos" / photo.name, np.minimum(picture * times, np.quantile(picture, 0.9999)))


def exposures(scene, copy, sd):
    """Each photograph brighter or darker by a factor of its own, as flashes that have not recharged make them: ln of it with that deviation, mean 0."""
    photos = photographs_of(scene)
    ln = np.random.default_rng(SEED).normal(size=len(photos))
    ln = sd * (ln - ln.mean()) / ln.std()
    for photo, by in zip(photos, np.exp(ln)):
        scene_copy.write_exr(copy / "photos" / photo.name, scene_copy.read_exr(photo) * by)


def vignetting(scene, copy, lost):
    """All photographs through a lens that loses that share of the light in the corners, with the square of the distance from the middle."""
    for photo in photographs_of(scene):
        picture = scene_copy.read_exr(photo)
        y, x = np.mgrid[0 : picture.shape[0], 0 : picture.shape[1]] + 0.5
        height, width = picture.shape[:2]
        square = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / ((width / 2) ** 2 + (height / 2) ** 2)
        scene_copy.write_exr(copy / "photos" / photo.name, picture * (1 - lost * square)[..., None])


def flash_pattern(scene, copy, lost):
    """All photographs with a flash that sends less off its axis (the camera's), by that share in the direction of the corners, with the square of the angle's tangent. What surfaces throw on each other is
    weaker by what the light that they receive is, in the mean over the picture."""
    camera = [l for l in (scene / "sparse/cameras.txt").read_text().splitlines() if not l.startswith("#")][0].split()
    fx, fy, cx, cy = map(float, camera[4:8])
    offset = np.array([float(v) for v in re.search(r"offset_in_camera\s*=\s*\[([^\]]*)\]", (scene / "project.toml").read_text()).group(1).split(",")])
    for photo in photographs_of(scene):
        picture = scene_copy.read_exr(photo)
        depth, terms = scene_copy.read_exr_channel(scene / "truth" / (photo.stem + "_depth.exr")), scene_copy.read_exr(scene / "truth" / (photo.stem + "_share.exr"))
        direct, thrown = (terms[..., c] / np.maximum(terms.sum(-1), 1e-9) for c in range(2))   # of the radiance: the flash's, and what it lights beside
        y, x = np.mgrid[0 : picture.shape[0], 0 : picture.shape[1]] + 0.5
        ray = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1)
        from_flash = ray * (depth / np.linalg.norm(ray, axis=-1))[..., None] - offset
        corner = (picture.shape[1] / 2 / fx) ** 2 + (picture.shape[0] / 2 / fy) ** 2
        square = (from_flash[..., 0] ** 2 + from_flash[..., 1] ** 2) / np.maximum(from_flash[..., 2], 1e-6) ** 2 / corner
        keeps = np.where(depth > 0, 1 - lost * np.clip(square, 0, 1.2), 1)
        mean = (terms[..., 0] * keeps).sum() / terms[..., 0].sum()
        scene_copy.write_exr(copy / "photos" / photo.name, picture * (1 - direct * (1 - keeps) - thrown * (1 - mean))[..., None])


def through_lens(picture, depth, focal_px, aperture, distance):
    """Each pixel the mean of the picture over the disc into which a lens focused at `distance` spreads a point at its depth; two kernels are mixed where the disc lies between them."""
    diameter = focal_px * aperture * np.abs(1 / distance - 1 / np.where(depth > 0, depth, distance))
    steps = np.arange(0, np.ceil(diameter.max()) + 1)
    result = np.zeros_like(picture)
    for d in steps:
        share = np.clip(1 - np.abs(diameter - d), 0, 1)[..., None]
        if not share.any():
            continue
        half = int(np.ceil(d / 2))
        fine = (np.arange(-8 * half - 4, 8 * half + 4) + 0.5) / 8   # eight samples a pixel
        disc = (fine[:, None] ** 2 + fine**2 <= max(d / 2, 0.1) ** 2).reshape(2 * half + 1, 8, 2 * half + 1, 8).sum((1, 3)).astype(float)
        result += share * np.stack([convolve(picture[..., c], disc / disc.sum(), mode="nearest") for c in range(3)], -1)
    return result


def defocus(scene, copy, millimetres, declared=True):
    """All photographs through an aperture of that diameter (a 35 mm lens at f/2.9 has 12), focused once at the median depth of all; the project file says so, or does not."""
    if millimetres == 0:
        return
    depths = {p: scene_copy.read_exr_channel(scene / "truth" / (p.stem + "_depth.exr")) for p in photographs_of(scene)}
    focal = float([l for l in (scene / "sparse/cameras.txt").read_text().splitlines() if not l.startswith("#")][0].split()[4])
    distance = float(np.median(np.concatenate([d[d > 0] for d in depths.values()])))
    for photo, depth in depths.items():
        scene_copy.write_exr(copy / "photos" / photo.name, through_lens(scene_copy.read_exr(photo), depth, focal, millimetres / 1000, distance))
    if declared:
        focus = "focus = { distance = %.6g, f_number = %.6g, focal_length = 0.035 }" % (distance, 35 / millimetres)
        edit_project(copy, lambda text: re.sub(r"(?m)^(\[\[acquisition\]\])", lambda m: m.group(1) + "\n" + focus, text))


def defocus_unknown(scene, copy, millimetres):
    defocus(scene, copy, millimetres, declared=False)


# name: (what is done, unit, levels, level that changes nothing)
ALL = {
    "normals_each": (normals_each, "degrees, each normal by itself", [1, 2, 5], 0),
    "normals_together": (normals_together, "degrees, normals alike over regions", [1, 2, 5], 0),
    "registration": (registration, "px, each photograph its own way", [0.5, 1, 2], 0),
    "flash_offset": (flash_offset, "cm, flash beside where it is said to be", [1, 2, 3], 0),
    "read_noise": (read_noise, "times the read noise, declared", [3, 10], 1),
    "interval": (interval, "times the calibrated range", [1 / 1.2, 1 / 1.1, 1.1, 1.2], 1),
    "ambient": (ambient, "times the ambient light, first photograph", [1.5, 2], 1),
    "ambient_each": (ambient_each, "rms of ln of the ambient light, each photograph its own", [0.15, 0.4], 0),
    "exposures": (exposures, "rms of ln, each photograph its own", [0.02, 0.05, 0.1], 0),
    "vignetting": (vignetting, "of the light lost in the corners", [0.15, 0.3], 0),
    "flash_pattern": (flash_pattern, "of the flash lost towards the corners", [0.2, 0.4], 0),
    "defocus": (defocus, "mm of aperture, focus at the median depth, declared", [6, 12], 0),
    "defocus_unknown": (defocus_unknown, "mm of aperture, not declared", [6, 12], 0),
    "overexposed": (overexposed, "times the exposure, first photograph, clipped", [2, 4], 1),
}

NEED_ALL_SHARES = {"ambient_each", "flash_pattern"}


def is_possible(name, scene):
    """Whether the scene's truth has what the disturbance is made from: the shares of light in every photograph (of the first one all rendered scenes have them)."""
    return name not in NEED_ALL_SHARES or all((scene / "truth" / (photo.stem + "_share.exr")).exists() for photo in photographs_of(scene))
