#!/usr/bin/env python3
"""Blending alone, beside MeshLab: photographs that are the albedo itself, of a scene whose albedo is known, put on its points by both.

usage: python3 tests/peers/meshlab_blend.py PROJECT OUT --meshlab PYTHON [--chiaro FILE] [--set KEY=VALUE …]      (needs numpy, scipy, OpenEXR, pillow from PyPI)
PROJECT: project file with solve.method = "none", photographs as EXR, cameras in sparse/ (COLMAP text, PINHOLE), truth/albedo.npy beside it. OUT: a folder.
PYTHON: an interpreter that has pymeshlab. MeshLab draws with OpenGL; without a screen: packages xvfb, libqt5gui5, libgl1-mesa-dri, QT_PLUGIN_PATH set to
Qt's folder of plugins, and this command under `xvfb-run -a`.

MeshLab: filter compute_color_from_active_rasters_projection with all its weights (angle, distance, borders, silhouettes). It takes 8 bits a channel: they
are sRGB-encoded, which keeps dark colours finer than linear ones would be. Masked pixels are transparent, and the filter is told so. Its depth tolerance is
absolute: several are tried, the row is that of the smallest mean error, its time that of the one filter call, loading apart. Normals, without which it cannot
weigh angles, are estimated by MeshLab and turned to the middle of the cameras; that is not in its time either.
chiaro: time and memory of the whole run are given beside those of its blend alone, as blending comes after casting rays, which is its visibility.
"""
import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

TOLERANCES = [0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.5]   # the last one is MeshLab's default
BLANK = (255, 0, 255)                                # of points that get no colour


def inside(words):
    """In the interpreter that has pymeshlab: colours by each tolerance, times."""
    import pymeshlab
    meshes = pymeshlab.MeshSet()
    began = time.perf_counter()
    meshes.load_project(str(words.project))
    eye = [float(v) for v in words.eye.split(",")]
    meshes.compute_normal_for_point_clouds(k=16, flipflag=True, viewpos=eye)
    print(json.dumps({"loading_s": time.perf_counter() - began, "points": meshes.current_mesh().vertex_number(), "rasters": meshes.raster_number()}), flush=True)
    for k, tolerance in enumerate(TOLERANCES):
        began = time.perf_counter()
        meshes.compute_color_from_active_rasters_projection(deptheta=tolerance, useangle=True, usedistance=True, useborders=True, usesilhouettes=True, usealpha=True,
                                                            blankcolor=pymeshlab.Color(*BLANK, 255))
        print(json.dumps({"tolerance": tolerance, "seconds": time.perf_counter() - began}), flush=True)
        np.save(words.out / f"meshlab_{k}.npy", meshes.current_mesh().vertex_color_matrix())


def srgb_from_linear(v):
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 1e-9) ** (1 / 2.4) - 0.055)


def linear_from_srgb(v):
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def write_meshlab_project(scene, folder, out):
    """Pictures of 8 bits and a project that places them. MeshLab's cameras look along -z with y up, the principal point is counted from below (given from
    above, errors double), and the translation is the negative centre. Returns the mean centre of the cameras."""
    from PIL import Image
    from blend_figures import cameras
    from scene_copy import read_exr
    rasters, centres = [], []
    for stem, (rotation, translation, (fx, fy, cx, cy)) in sorted(cameras(scene / "sparse").items()):
        if not (scene / folder / f"{stem}.exr").exists():
            continue
        picture = read_exr(scene / folder / f"{stem}.exr")
        height, width, _ = picture.shape
        mask = np.asarray(Image.open(scene / "masks" / f"{stem}.png").convert("L"))
        eight = np.rint(255 * srgb_from_linear(np.clip(picture, 0, 1))).astype(np.uint8)
        Image.fromarray(np.dstack([eight, np.where(mask > 127, 255, 0).astype(np.uint8)])).save(out / f"{stem}.png")
        centre = -rotation.T @ translation
        centres.append(centre)
        turned = np.diag([1.0, -1.0, -1.0]) @ rotation
        matrix = " ".join("%.12g" % v for row in turned for v in (*row, 0)) + " 0 0 0 1"
        numbers = lambda values: " ".join("%.12g" % v for v in values)
        camera = {"TranslationVector": numbers([*-centre, 1]), "LensDistortion": "0 0", "ViewportPx": f"{width} {height}", "PixelSizeMm": numbers([1 / fx, 1 / fy]),
                  "FocalMm": "1", "CenterPx": numbers([cx, height - cy]), "RotationMatrix": matrix, "CameraType": "0", "BinaryData": "0"}
        rasters.append(f'<MLRaster label="{stem}"><VCGCamera ' + " ".join(f"{k}={quoteattr(v)}" for k, v in camera.items()) + f'/><Plane semantic="1" fileName="{stem}.png"/></MLRaster>')
    cloud = quoteattr(str((scene / "cloud.ply").resolve()))
    (out / "project.mlp").write_text('<!DOCTYPE MeshLabDocument>\n<MeshLabProject>\n<MeshGroup>\n'
                                     f'<MLMesh label="cloud" filename={cloud} visible="1"><MLMatrix44>\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n</MLMatrix44></MLMesh>\n'
                                     "</MeshGroup>\n<RasterGroup>\n" + "\n".join(rasters) + "\n</RasterGroup>\n</MeshLabProject>\n")
    return np.mean(centres, 0)


def blend_seconds(record):
    return sum(s["seconds"] for s in record["stages"] if s["name"] == "blend")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--meshlab", type=Path, help="interpreter that has pymeshlab")
    parser.add_argument("--chiaro", type=Path, default=Path(__file__).parents[2] / "build/release/chiaro")
    parser.add_argument("--set", nargs="+", default=[])
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--eye", help=argparse.SUPPRESS)
    words = parser.parse_args()
    if words.inside:
        return inside(words)
    sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "bench")]
    from blend_figures import Figures, mean_median, relative
    from chiaro_runs import timed
    scene, run, theirs = words.project.parent, words.out / "chiaro", words.out / "meshlab"
    theirs.mkdir(parents=True, exist_ok=True)
    folder = "blend" if "blend/" in words.project.read_text() else "photos"

    command = [str(words.chiaro), "run", str(words.project), "--out", str(run), "--quiet"] + [w for s in words.set for w in ("--set", s)]
    began = time.perf_counter()
    code, core, peak = timed(command, words.out / "log.txt")
    whole = time.perf_counter() - began
    if code not in (0, 3):
        sys.exit(f"{' '.join(command)}: exit {code}, see {words.out / 'log.txt'}")
    f = Figures(scene, run)
    weights, mean, best = f.plain()
    blended = blend_seconds(json.loads((run / "run.json").read_text()))
    rows = [("chiaro", f.blend, f.photos > 0, f"{blended:.1f} (whole run {whole:.1f})", peak)]
    for name, albedo in (("weighted mean, chiaro's visibility", mean), ("best photograph, chiaro's visibility", best)):
        rows.append((name, albedo, (weights > 0).any(1), "", None))

    if words.meshlab:
        eye = write_meshlab_project(scene, folder, theirs)
        log = theirs / "log.txt"
        log.unlink(missing_ok=True)
        code, core, peak = timed([str(words.meshlab), __file__, str(theirs / "project.mlp"), str(theirs), "--inside", "--eye=" + ",".join("%.9g" % v for v in eye)], log)
        said = [json.loads(line) for line in log.read_text().splitlines() if line.startswith("{")]
        if code != 0 or len(said) != 1 + len(TOLERANCES):
            sys.exit(f"MeshLab: exit {code}, see {log}")
        tried = []
        for k, one in enumerate(said[1:]):
            colours = np.load(theirs / f"meshlab_{k}.npy")
            coloured, albedo = (np.abs(255 * colours[:, :3] - BLANK) > 0.5).any(1), linear_from_srgb(colours[:, :3])
            tried.append((np.mean(relative(albedo[coloured], f.truth[coloured])), one, albedo, coloured))
            print(f"MeshLab, depth tolerance {one['tolerance']}: {100 * np.mean(coloured):.1f} % coloured, error {mean_median(relative(albedo[coloured], f.truth[coloured]))} %, {one['seconds']:.1f} s")
        _, one, albedo, coloured = min(tried, key=lambda t: t[0])
        rows.append((f"MeshLab, depth tolerance {one['tolerance']}", albedo, coloured, f"{one['seconds']:.1f} (loading and normals {said[0]['loading_s']:.1f})", peak))

    common = np.logical_and.reduce([seen for _, _, seen, _, _ in rows])
    print(f"\n{len(f.points)} points, {len(f.names)} photographs; {100 * np.mean(common):.1f} % of the points have a colour from all\n")
    print("| | points with a colour, % | error there, mean / median, % | error on the common points, % | s | peak MiB |\n| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, albedo, seen, seconds, peak in rows:
        print(f"| {name} | {100 * np.mean(seen):.1f} | {mean_median(relative(albedo[seen], f.truth[seen]))} | {mean_median(relative(albedo[common], f.truth[common]))} | {seconds} | {'' if peak is None else round(peak)} |")


if __name__ == "__main__":
    main()
