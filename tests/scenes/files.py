"""Writes a scene in the layout of a project with known answers: see docs/peers.md."""
import json
from pathlib import Path

import numpy as np
import mitsuba as mi


def write_exr(path, image):
    """Half-float RGB, or one channel."""
    mi.Bitmap(np.ascontiguousarray(image.astype(np.float16))).write(str(path))


def write_mask(path, mask):
    mi.Bitmap(np.ascontiguousarray(np.where(mask, 255, 0).astype(np.uint8))).write(str(path))


def write_cloud(path, points, normals=None):
    columns = points if normals is None else np.concatenate([points, normals], axis=1)
    names = ["x", "y", "z", "nx", "ny", "nz"][:columns.shape[1]]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex %d\n%send_header\n" % (len(points), "".join("property float %s\n" % n for n in names))
    with open(path, "wb") as f:
        f.write(header.encode())
        f.write(columns.astype("<f4").tobytes())


def quaternion(r):
    """(w, x, y, z) with w >= 0, of a rotation matrix: the eigenvector of Bar-Itzhack's symmetric matrix, exact for every angle."""
    k = np.array([[r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0], [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
                  [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0], [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)]]) / 3
    values, vectors = np.linalg.eigh(k, UPLO="L")
    x, y, z, w = vectors[:, np.argmax(values)]
    q = np.array([w, x, y, z])
    return q if w >= 0 else -q


def write_cameras(folder, scene, views):
    folder.mkdir(parents=True, exist_ok=True)
    w, h = scene.size
    (folder / "cameras.txt").write_text("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 PINHOLE %d %d %.9g %.9g %.9g %.9g\n" % (w, h, scene.focal, scene.focal, *scene.principal))
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line of points\n"]
    for n, view in enumerate(views, 1):
        r, t = view.camera_from_world()
        lines.append("%d %s 1 %s.exr\n\n" % (n, " ".join("%.12g" % v for v in (*quaternion(r), *t)), view.name))
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("# none\n")


def interval(scene):
    return [round(scene.flash * f, 2) for f in scene.interval]


def write_project(path, scene, offset, reference=None):
    text = """[project]
name = "%s"
unit = "m"

[cloud]
files   = ["cloud.ply"]
normals = "auto"

[[acquisition]]
name        = "day1"
photographs = ["photos/photo_??.exr"]
encoding    = "linear"
masks       = "masks/{stem}.png"
cameras     = "sparse"
noise       = { gain = %g, read_sigma = %g }

[acquisition.flash]
offset_in_camera = [%g, %g, %g]
intensity_range  = [%g, %g]

[acquisition.ambient]
model = "auto"
""" % (path.stem.replace("project", scene.name), scene.gain, scene.read_sigma, *offset, *interval(scene))
    if reference:
        text += """
[[acquisition.reference]]
photograph = "%s"
polygon    = %s
albedo     = [%s]
sigma      = 0.01
""" % (reference["photograph"], json.dumps(reference["polygon"]), ", ".join("%.4g" % v for v in reference["albedo"]))
    path.write_text(text + '\n[[export]]\nfile = "albedo.ply"\n')


def write_views(path, scene, views):
    text = []
    for view in views:
        r, t = view.camera_from_world()
        rows = ", ".join("[%s]" % ", ".join("%.9g" % v for v in row) for row in r)
        text.append("""[[view]]
name = "%s"
size = [%d, %d]
camera = { model = "PINHOLE", params = [%g, %g, %g, %g] }
rotation_camera_from_world = [%s]
translation_camera_from_world = [%s]
flash_offset_in_camera = [%g, %g, %g]
flash_intensity = %g
""" % (view.name, *scene.size, scene.focal, scene.focal, *scene.principal, rows, ", ".join("%.9g" % v for v in t), *view.flash_offset, scene.flash))
    path.write_text("\n".join(text))


def write_lights(path, scene, extra):
    views = []
    for view in scene.views:
        r, t = view.camera_from_world()
        views.append({"name": view.name, "held_out": view.held_out, "rotation_camera_from_world": r.tolist(), "translation_camera_from_world": t.tolist(),
                      "flash_offset_in_camera_m": list(view.flash_offset)})
    record = {"flash_intensity_w_per_sr": scene.flash, "ambient_radiance": scene.ambient, "ambient": "uniform gray", "surroundings_not_in_cloud": 0,
              "bounces": scene.segments - 1, "spp": scene.spp, **extra, "views": views}
    Path(path).write_text(json.dumps(record, indent=1) + "\n")
