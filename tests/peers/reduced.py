"""A smaller copy of a scene with known answers, so that slow peers finish: photographs averaged over blocks of pixels, points thinned at random."""
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import mitsuba as mi

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scenes"))


def read_exr(path):
    return np.array(mi.Bitmap(str(path))).astype(np.float64)


def blocks(image, factor, how):
    h, w = image.shape[0] // factor, image.shape[1] // factor
    cut = image[:h * factor, :w * factor].reshape((h, factor, w, factor) + image.shape[2:])
    return how(cut, axis=(1, 3))


def pinhole(folder):
    """((width, height), (fx, fy, cx, cy), {stem: (R, t)}) of a COLMAP text folder with one PINHOLE camera."""
    from check_scene import read_cameras
    return read_cameras(Path(folder) / "sparse")


def flash_of(project):
    """(offset in the camera, (low, high)) from the text of a project file."""
    number = lambda key: [float(v) for v in re.search(key + r"\s*=\s*\[(.*)\]", project).group(1).split(",")]
    return np.array(number("offset_in_camera")), tuple(number("intensity_range"))


def thin_cloud(source, target, number, rng):
    """Keeps `number` random points; returns their indices in the order kept."""
    raw = source.read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    header = raw[:end].decode()
    total = int(re.search(r"element vertex (\d+)", header).group(1))
    stride = 4 * header.count("property float")
    kept = np.arange(total) if number >= total else rng.choice(total, number, replace=False)
    rows = np.frombuffer(raw, np.uint8, total * stride, end).reshape(total, stride)[kept]
    target.write_bytes(re.sub(r"element vertex \d+", "element vertex %d" % len(kept), header).encode() + rows.tobytes())
    return kept


def reduce(source, out, factor, points, photographs):
    """Writes the reduced scene with these photographs alone into the folder `out`."""
    source, out = Path(source), Path(out)
    shutil.rmtree(out, ignore_errors=True)
    for folder in ("photos", "masks", "sparse", "truth"):
        (out / folder).mkdir(parents=True)
    kept = thin_cloud(source / "cloud.ply", out / "cloud.ply", points, np.random.default_rng(7))
    np.save(out / "truth/albedo.npy", np.load(source / "truth/albedo.npy")[kept])
    shutil.copy(source / "truth/lights.json", out / "truth/lights.json")
    for name in photographs:
        small = blocks(read_exr(source / "photos" / (name + ".exr")), factor, np.mean)
        mi.Bitmap(small.astype(np.float32)).write(str(out / "photos" / (name + ".exr")))
        mask = np.array(mi.Bitmap(str(source / "masks" / (name + ".png"))))
        mi.Bitmap(blocks(mask.reshape(mask.shape[:2]), factor, np.min)).write(str(out / "masks" / (name + ".png")))
    camera = (source / "sparse/cameras.txt").read_text().splitlines()
    head, line = [l for l in camera if l.startswith("#")], [l for l in camera if not l.startswith("#")][0].split()
    line[2:] = [str(int(line[2]) // factor), str(int(line[3]) // factor)] + ["%.9g" % (float(v) / factor) for v in line[4:8]]
    (out / "sparse/cameras.txt").write_text("\n".join(head + [" ".join(line)]) + "\n")
    for name in ("images.txt", "points3D.txt"):
        shutil.copy(source / "sparse" / name, out / "sparse" / name)
    project = (source / "project.toml").read_text()
    project = re.sub(r"(?m)^photographs\s*=.*$", "photographs = [%s]" % ", ".join('"photos/%s.exr"' % n for n in photographs), project)
    noise = [float(re.search(key + r" = ([\d.e+-]+)", project).group(1)) for key in ("gain", "read_sigma")]
    project = re.sub(r"(?m)^noise\s*=.*$", "noise = { gain = %.9g, read_sigma = %.9g }" % (noise[0] / factor ** 2, noise[1] / factor), project)
    (out / "project.toml").write_text(project)
