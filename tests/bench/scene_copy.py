"""Copies of a scene of which one thing is changed, and the files that such changes need: photographs as EXR, cameras as COLMAP text, clouds as PLY."""
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import OpenEXR


def read_exr(path):
    """Height x width x 3, float32."""
    channels = OpenEXR.File(str(path)).channels()
    return (np.asarray(channels["RGB"].pixels) if "RGB" in channels else np.stack([channels[c].pixels for c in "RGB"], -1)).astype(np.float32)


def read_exr_channel(path):
    """The only channel of a file, height x width."""
    return np.asarray(next(iter(OpenEXR.File(str(path)).channels().values())).pixels, dtype=np.float32)


def write_exr(path, picture):
    """Half floats, in place of what is there: a link is not followed."""
    Path(path).unlink(missing_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": picture.astype(np.float16)}).write(str(path))


def write_text(path, text):
    """In place of what is there: a link is not followed."""
    Path(path).unlink(missing_ok=True)
    Path(path).write_text(text)


def link_scene(scene, copy):
    """The folder `copy`, made anew, whose files are links to the scene's; without its truth and the photographs kept back."""
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(scene, copy, ignore=shutil.ignore_patterns("truth", "novel"), copy_function=lambda a, b: Path(b).symlink_to(Path(a).resolve()))
    subprocess.run(["chmod", "-R", "u+w", str(copy)], check=True)


def read_cloud(path):
    """(N, 3) positions and (N, 3) normals or None, of a binary PLY of floats."""
    data = Path(path).read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    names = re.findall(r"^property float (\w+)\s*$", data[:start].decode(), re.M)
    table = np.frombuffer(data[start:], np.dtype([(n, "<f4") for n in names]))
    column = lambda wanted: np.stack([table[n] for n in wanted], 1).astype(np.float64)
    return column("xyz"), column(["nx", "ny", "nz"]) if "nx" in names else None


def write_cloud(path, points, normals):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex %d\n%send_header\n" % (len(points), "".join("property float %s\n" % n for n in ("x", "y", "z", "nx", "ny", "nz")))
    Path(path).unlink(missing_ok=True)
    Path(path).write_bytes(header.encode() + np.concatenate([points, normals], 1).astype("<f4").tobytes())
