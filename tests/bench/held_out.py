#!/usr/bin/env python3
"""Predicts photographs that were kept back: a run without every n-th photograph, its pictures from their cameras beside them, and the same with the direct-only way.

    python tests/bench/held_out.py PROJECT.toml OUT [--every 5] [--shrink 1] [--memory 1GiB] [--chiaro EXE] [--set KEY=VALUE …]

PROJECT has its cameras as COLMAP text and one acquisition; photographs are JPEG, PNG (sRGB) or EXR. Needs numpy, scipy, pillow and OpenEXR from PyPI.
Prints a row a photograph: PSNR (linear, peak 1) and median |ln(predicted / photographed)| over the pixels that both predictions have, at least four pixels from where they end,
not saturated and inside the mask; as predicted, and after the one factor that fits best. OUT/pictures holds photograph, ours, direct and both differences, side by side.
"""
import argparse
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import binary_erosion

import scene_copy

ROOT = Path(__file__).resolve().parents[2]
METHODS = ("joint", "direct")
SATURATED = 0.97 ** 2.2


def colmap_views(folder, shrink=1):
    """{stem: text of a [[view]]} of a COLMAP text model; pictures `shrink` times smaller."""
    rows = [l.split() for l in (folder / "cameras.txt").read_text().splitlines() if l and l[0] != "#"]
    lenses = {}
    for r in rows:   # focal lengths and principal point first, one or two of the former
        lengths = 3 if r[1].startswith("SIMPLE") or r[1] in ("RADIAL", "RADIAL_FISHEYE") else 4
        numbers = [float(v) / (shrink if k < lengths else 1) for k, v in enumerate(r[4:])]
        lenses[r[0]] = "size = [%d, %d]\ncamera = { model = \"%s\", params = %s }\n" % (int(r[2]) // shrink, int(r[3]) // shrink, r[1], numbers)
    views = {}
    for line in [l for l in (folder / "images.txt").read_text().splitlines() if not l.startswith("#")][::2]:
        words = line.split(maxsplit=9)
        if len(words) < 10:
            continue
        w, x, y, z = map(float, words[1:5])
        r = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
        stem = Path(words[9]).stem
        views[stem] = "[[view]]\nname = \"%s\"\n%srotation_camera_from_world = %s\ntranslation_camera_from_world = %s\n\n" % (stem, lenses[words[8]], r, [float(v) for v in words[5:8]])
    return views


def toml_of(table, path=""):
    """Text of tables, arrays of tables and plain values."""
    value = lambda v: ("true" if v else "false") if isinstance(v, bool) else '"%s"' % v if isinstance(v, str) else "[%s]" % ", ".join(map(value, v)) if isinstance(v, list) \
        else "{ %s }" % ", ".join("%s = %s" % (k, value(x)) for k, x in v.items()) if isinstance(v, dict) else repr(v)
    nested = lambda v: isinstance(v, dict) or (isinstance(v, list) and v and isinstance(v[0], dict))
    text = "".join("%s = %s\n" % (k, value(v)) for k, v in table.items() if not nested(v))
    for k, v in table.items():
        for one in (v if isinstance(v, list) else [v]) if nested(v) else []:
            name = path + k
            text += ("\n[[%s]]\n" if isinstance(v, list) else "\n[%s]\n") % name + toml_of(one, name + ".")
    return text


def split(project, every, out, shrink):
    """Writes the projects of what is used; returns ({stem: file} of what is kept back, views of it, mask pattern)."""
    words = tomllib.loads(project.read_text())
    here = project.resolve().parent
    acquisition = words["acquisition"][0]
    views = colmap_views(here / acquisition["cameras"], shrink)
    files = sorted(f for pattern in acquisition["photographs"] for f in here.glob(pattern))
    posed = [f for f in files if f.stem in views]
    kept = {f.stem: f for f in posed[every - 1::every]}
    acquisition["photographs"] = [str(f) for f in posed if f.stem not in kept]
    acquisition["cameras"] = str(here / acquisition["cameras"])
    if "masks" in acquisition:
        acquisition["masks"] = str(here / acquisition["masks"])
    words["cloud"]["files"] = [str(here / f) for f in words["cloud"]["files"]]
    out.mkdir(parents=True, exist_ok=True)
    (out / "project.toml").write_text(toml_of(words))
    (out / "views.toml").write_text("".join(views[stem] for stem in kept))
    print("%d photographs used, %d kept back" % (len(posed) - len(kept), len(kept)))
    return kept, acquisition.get("masks")


def linear(file):
    if file.suffix == ".exr":
        return scene_copy.read_exr(file).astype(np.float64)
    v = np.asarray(Image.open(file).convert("RGB"), np.float64) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def blocks(picture, shrink, how=np.mean):
    h, w = picture.shape[0] // shrink, picture.shape[1] // shrink
    return how(picture[:h * shrink, :w * shrink].reshape((h, shrink, w, shrink) + picture.shape[2:]), axis=(1, 3))


def encoded(picture):
    v = np.clip(picture, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)


def figures(predicted, photograph, where):
    """(PSNR, median |ln ratio|, PSNR after one factor)."""
    p, q = predicted[where], photograph[where]
    psnr = lambda a: 10 * np.log10(1 / np.mean((np.clip(a, 0, 1) - np.clip(q, 0, 1)) ** 2))
    ln = np.abs(np.log(np.maximum(p.mean(-1), 1e-5) / np.maximum(q.mean(-1), 1e-5)))
    return psnr(p), float(np.median(ln)), psnr(p * (np.sum(p * q) / np.sum(p * p)))


def strip(file, photograph, predictions, where, width=480):
    """Photograph, predictions, and what they are off by (grey: nothing; a fifth of the scale is full), all with the same exposure."""
    gain = 0.8 / max(1e-6, np.quantile(photograph[where], 0.98))
    tiles = [encoded(photograph * gain)] + [encoded(p * gain) for p in predictions]
    tiles += [np.where(where[..., None], np.clip(0.5 + 2.5 * (p - photograph) * gain, 0, 1), 0.5) for p in predictions]
    small = [Image.fromarray((255 * t).astype(np.uint8)).resize((width, width * t.shape[0] // t.shape[1]), Image.BOX) for t in tiles]
    sheet = Image.new("RGB", (width * len(small), small[0].height))
    for k, tile in enumerate(small):
        sheet.paste(tile, (k * width, 0))
    sheet.save(file)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=5)
    parser.add_argument("--shrink", type=int, default=1, help="compare pictures so many times smaller: photographs averaged over blocks")
    parser.add_argument("--memory", default="1GiB")
    parser.add_argument("--chiaro", type=Path, default=ROOT / "build/release/chiaro")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="handed on to chiaro run")
    options = parser.parse_args()
    kept, masks = split(options.project, options.every, options.out, options.shrink)
    more = [word for pair in options.set for word in ("--set", pair)]
    run = options.out / "run"   # one folder: rays are cast once for both
    for method in METHODS:
        pictures = options.out / (method + ".views")
        for command in ([options.chiaro, "run", options.out / "project.toml", "--out", run, "--memory", options.memory, "--quiet", "--set", "solve.method=" + method, *more],
                        [options.chiaro, "render", run, "--views", options.out / "views.toml", "--out", pictures, "--quiet", *(["--direct"] if method == "direct" else [])]):
            result = subprocess.run([str(c) for c in command], capture_output=True, text=True)
            if result.returncode not in (0, 3):
                sys.exit("%s: exit %d\n%s" % (" ".join(map(str, command)), result.returncode, result.stderr))
    (options.out / "pictures").mkdir(exist_ok=True)
    print("| photograph | pixels compared, % | PSNR, dB: ours | direct | median off by, %: ours | direct | PSNR after one factor, dB: ours | direct |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    all_rows = []
    for stem, file in kept.items():
        whole = linear(file)
        photograph = blocks(whole, options.shrink)
        predictions = [scene_copy.read_exr(options.out / (method + ".views") / (stem + ".exr")).astype(np.float64) for method in METHODS]
        where = np.all([np.isfinite(p).all(-1) & (p.max(-1) > 0) for p in predictions], axis=0)
        where = binary_erosion(where, iterations=max(1, 4 // options.shrink))
        if file.suffix != ".exr":
            where &= blocks(whole.max(-1), options.shrink, np.max) < SATURATED
        if masks and Path(masks.replace("{stem}", stem)).exists():
            where &= blocks(np.asarray(Image.open(masks.replace("{stem}", stem)).convert("L")), options.shrink, np.min) > 127
        if where.mean() < 0.001:
            print("| %s | %.1f | nothing of it is predicted |" % (stem, 100 * where.mean()))
            continue
        ours, direct = (figures(p, photograph, where) for p in predictions)
        all_rows.append((*ours, *direct))
        print("| %s | %.1f | %.1f | %.1f | %.1f | %.1f | %.1f | %.1f |" % (stem, 100 * where.mean(), ours[0], direct[0], 100 * ours[1], 100 * direct[1], ours[2], direct[2]), flush=True)
        strip(options.out / "pictures" / (stem + ".png"), photograph, predictions, where)
    m = np.mean(all_rows, 0)
    print("| mean | | %.1f | %.1f | %.1f | %.1f | %.1f | %.1f |" % (m[0], m[3], 100 * m[1], 100 * m[4], m[2], m[5]))


if __name__ == "__main__":
    main()
