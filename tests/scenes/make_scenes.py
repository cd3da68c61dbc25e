#!/usr/bin/env python3
"""Renders an acquisition with known answers: cloud, flash photographs, cameras, masks, project, held-out views, truth.

    python3 -m venv scenes_env && scenes_env/bin/pip install -r tests/scenes/requirements.txt
    export DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1        # Debian: libllvm19
    scenes_env/bin/python tests/scenes/make_scenes.py NAME OUT [--scale S] [--spp N] [--list]

Makes OUT/NAME. --scale 0.5 halves pixels and points a side, --spp overrides the paths a pixel. The layout is described in docs/peers.md.
"""
import argparse
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")

import files                # noqa: E402  (a variant has to be chosen first)
import mesh as meshing      # noqa: E402
import render               # noqa: E402
from scenes import SCENES   # noqa: E402

PATCH = 9                   # pixels a side of the reference patch


def build(scene):
    """(mesh, reflectance, albedo), the colours at the faces' corners (F, 3, 3): the same but where the surface is glossy."""
    mesh = meshing.surface_net(scene.distance, scene.low, scene.high, scene.cell)
    reflectance = render.corner_colours(scene, mesh, scene.paint(mesh.vertices.astype(np.float64)))
    factor = np.array([render.diffuse_albedo_factor(m.alpha) for m in scene.materials], np.float32)
    return mesh, reflectance, reflectance * factor[render.material_of_faces(scene, mesh)][:, None, None]


def write_points(scene, mesh, albedo, out, rng):
    face, weights = meshing.sample(mesh, scene.points, rng)
    points = np.einsum("nk,nkc->nc", weights, mesh.corners()[face])
    points += scene.scan_noise * rng.normal(size=points.shape)
    _, normals = mesh.areas_normals()
    files.write_cloud(out / "cloud.ply", points, normals[face] if scene.normals else None)
    np.save(out / "truth/albedo.npy", np.einsum("nk,nkc->nc", weights, albedo[face]).astype(np.float16))
    np.save(out / "truth/normal.npy", normals[face].astype(np.float16))
    if len(scene.materials) > 1:
        np.save(out / "truth/material.npy", render.material_of_faces(scene, mesh)[face].astype(np.uint8))


def with_noise(image, scene, rng):
    return image + rng.normal(size=image.shape) * np.sqrt(scene.gain * np.maximum(image, 0) + scene.read_sigma ** 2)


def flattest_patch(albedo, covered, photograph):
    """The brightest of the patches with the least texture, well inside: where a colour chart would stand."""
    h, w = covered.shape
    best = None
    for y in range(PATCH, h - 2 * PATCH, 3):
        for x in range(PATCH, w - 2 * PATCH, 3):
            wide = (slice(y - 2, y + PATCH + 2), slice(x - 2, x + PATCH + 2))
            if not covered[wide].all():
                continue
            cut = albedo[wide]
            score = (cut.std(axis=(0, 1)) / cut.mean(axis=(0, 1))).max() - 0.05 * cut.mean()
            if best is None or score < best[0]:
                best = (score, x, y)
    _, x, y = best
    return {"photograph": photograph, "polygon": [[x, y], [x + PATCH, y], [x + PATCH, y + PATCH], [x, y + PATCH]],
            "albedo": albedo[y:y + PATCH, x:x + PATCH].mean(axis=(0, 1)).tolist()}


def make(scene, out):
    for folder in ("photos", "masks", "novel", "truth", "sparse"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(scene.seed)
    mesh, reflectance, albedo = build(scene)
    say("%s: %d triangles, %.1f m2" % (scene.name, len(mesh.faces), mesh.areas_normals()[0].sum()))
    write_points(scene, mesh, albedo, out, rng)
    shapes = render.mitsuba_meshes(scene, mesh, reflectance)
    reference = None
    for number, view in enumerate(scene.views):
        direct, whole, ambient = render.parts(scene, shapes, view, scene.seed * 100 + number)
        covered, pixel_albedo, depth = render.pixel_truth(scene, mesh, albedo, view)
        files.write_mask(out / "masks" / (view.name + ".png"), covered)
        files.write_exr(out / "truth" / (view.name + "_depth.exr"), depth)
        image = whole + ambient
        if view.held_out:
            files.write_exr(out / "novel" / (view.name + ".exr"), image)
        else:
            files.write_exr(out / "photos" / (view.name + ".exr"), with_noise(image, scene, rng))
            files.write_exr(out / "truth" / (view.name + "_albedo.exr"), pixel_albedo)
            files.write_exr(out / "truth" / (view.name + "_share.exr"), np.stack([direct.mean(2), (whole - direct).mean(2), ambient.mean(2)], 2))
        reference = reference or flattest_patch(pixel_albedo, covered, view.name)
        lit = image[covered]
        say("%s: %.0f %% covered, radiance median %.3f, 99 %% %.3f; shares direct %.2f bounced %.2f ambient %.2f" %
            (view.name, 100 * covered.mean(), np.median(lit), np.percentile(lit, 99), *(np.array([direct[covered].mean(), (whole - direct)[covered].mean(), ambient[covered].mean()]) / lit.mean())))
    taken, held = [v for v in scene.views if not v.held_out], [v for v in scene.views if v.held_out]
    files.write_cameras(out / "sparse", scene, taken)
    files.write_project(out / "project.toml", scene, taken[0].flash_offset)
    files.write_project(out / "project_reference.toml", scene, taken[0].flash_offset, reference)
    files.write_views(out / "novel/views.toml", scene, held)
    extra = {}
    if any(m.alpha for m in scene.materials):
        extra = {"roughness": [m.alpha for m in scene.materials], "albedo_is": "pi times the diffuse lobe for light and view along the normal",
                 "albedo_over_diffuse_reflectance": [render.diffuse_albedo_factor(m.alpha) for m in scene.materials]}
    files.write_lights(out / "truth/lights.json", scene, extra)


def say(text):
    print("%6.0f s  %s" % (time.process_time(), text), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", choices=sorted(SCENES))
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--spp", type=int)
    parser.add_argument("--list", action="store_true", help="names of the scenes")
    options = parser.parse_args()
    if options.list:
        print("\n".join(sorted(SCENES)))
        return
    if not options.name or not options.out:
        parser.error("NAME and OUT are needed, or --list")
    scene = SCENES[options.name]()
    if options.scale != 1:
        scene = scene.scaled(options.scale)
    if options.spp:
        scene.spp = options.spp
    out, part = options.out / options.name, options.out / (options.name + ".part")
    if out.exists():
        sys.exit("error: %s exists already" % out)
    shutil.rmtree(part, ignore_errors=True)
    make(scene, part)
    part.rename(out)


if __name__ == "__main__":
    main()
