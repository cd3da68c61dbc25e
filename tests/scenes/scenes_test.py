#!/usr/bin/env python3
"""Tests of the recipes:   python tests/scenes/scenes_test.py        (about two minutes; needs what requirements.txt names)"""
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import files            # noqa: E402
import mesh as meshing  # noqa: E402
import render           # noqa: E402
import solids           # noqa: E402
from check_scene import Glossy  # noqa: E402
from scene import Scene, View   # noqa: E402


class Meshes(unittest.TestCase):
    def setUp(self):
        self.mesh = meshing.surface_net(lambda p: solids.sphere(p, (0.1, 0, 0), 0.5), (-0.6, -0.7, -0.7), (0.8, 0.7, 0.7), 0.03)

    def test_a_sphere_has_its_area_and_faces_outward(self):
        area, normal = self.mesh.areas_normals()
        # A polyhedron inside the sphere: smaller by about (cell / radius)^2 / 6.
        self.assertLess(abs(area.sum() / np.pi - 1), 0.03 ** 2 / 0.5 ** 2)
        centre = self.mesh.corners().mean(axis=1) - [0.1, 0, 0]
        self.assertGreater(np.einsum("ij,ij->i", normal, centre / np.linalg.norm(centre, axis=1)[:, None]).min(), 0.98)

    def test_it_is_closed(self):
        edges = np.concatenate([self.mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
        forth, back = {tuple(e) for e in edges}, {tuple(e[::-1]) for e in edges}
        self.assertEqual(forth, back)

    def test_points_are_uniform_by_area(self):
        face, weights = meshing.sample(self.mesh, 40_000, np.random.default_rng(1))
        p = np.einsum("nk,nkc->nc", weights, self.mesh.corners()[face]) - [0.1, 0, 0]
        # Archimedes: heights on a sphere are uniform; five standard deviations of a share.
        share = np.histogram(p[:, 2], 10, (-0.5, 0.5))[0] / len(p)
        self.assertLess(np.abs(share - 0.1).max(), 5 * np.sqrt(0.1 * 0.9 / len(p)))


class Cameras(unittest.TestCase):
    def test_quaternions_give_back_the_rotation(self):
        rng = np.random.default_rng(2)
        for _ in range(200):
            view = View("v", tuple(rng.normal(size=3)), tuple(rng.normal(size=3)), rng.uniform(-180, 180))
            r, _ = view.camera_from_world()
            w, x, y, z = files.quaternion(r)
            back = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
            self.assertLess(np.abs(back - r).max(), 1e-12)
            self.assertLess(abs(np.linalg.det(r) - 1), 1e-12)


def plate(material_dict):
    """A plate of 2 m in the plane z = 0, facing up."""
    return {"object": {"type": "rectangle", "bsdf": material_dict}}


def plate_scene(size=(16, 16)):
    return Scene("plate", None, None, None, 1, None, [], 1, 0, size=size, focal=400.0, principal=(size[0] / 2, size[1] / 2))


class Gloss(unittest.TestCase):
    """What "albedo" means on roughplastic, found by rendering."""

    def body(self, alpha, reflectance):
        return {"type": "roughplastic", "distribution": "ggx", "alpha": alpha, "nonlinear": False, "specular_reflectance": {"type": "rgb", "value": [0.0] * 3},
                "diffuse_reflectance": {"type": "rgb", "value": [reflectance] * 3}}

    def test_a_flash_along_the_normal_shows_albedo_over_pi(self):
        view = View("v", (0, 1e-3, 2.0), (0, 0, 0), flash_offset=(0, 0, 0))
        for alpha in (0.15, 0.3, 0.4):
            image = render.radiance(plate(self.body(alpha, 0.5)), render.flash_emitter(view.flash_in_world(), 7.0), render.sensor(plate_scene(), view, 16), 2, 1, 16)
            expected = 0.5 * render.diffuse_albedo_factor(alpha) / np.pi * 7.0 / 4.0
            self.assertLess(abs(image.mean() / expected - 1), 1e-3)      # the view spans 1.6 degrees

    def test_a_uniform_sky_agrees_with_the_integral_of_the_lobe(self):
        view = View("v", (0, 1e-3, 2.0), (0, 0, 0))
        for alpha in (0.15, 0.4):
            image = render.radiance(plate(self.body(alpha, 0.5)), render.ambient_emitter(1.0), render.sensor(plate_scene((64, 64)), view, 256), 2, 1, 256)
            cosine = (np.arange(4000) + 0.5) / 4000
            expected = 2 * np.pi * np.mean(render.body_lobe(alpha, np.arccos(cosine), 0.5) * cosine)
            self.assertLess(abs(image.mean() / expected - 1), 3e-3)
            self.assertLess(image.mean(), 0.5 * render.diffuse_albedo_factor(alpha))     # white-sky is lower

    def test_the_lobe_falls_as_the_independent_formula_says(self):
        angles = np.radians([0, 20, 40, 60, 75])
        for alpha in (0.15, 0.25, 0.4):
            glossy = Glossy(alpha)
            ours = np.interp(np.cos(angles), glossy.cosines, glossy.through) / glossy.through[-1]
            theirs = render.body_lobe(alpha, angles)
            self.assertLess(np.abs(ours * theirs[0] / theirs - 1).max(), 2e-3)       # Mitsuba tabulates T at 64 cosines


class WholeScenes(unittest.TestCase):
    def run_check(self, folder):
        return subprocess.run([sys.executable, str(HERE / "check_scene.py"), str(folder)], capture_output=True, text=True)

    def test_small_scenes_pass_the_check_and_damaged_ones_do_not(self):
        with tempfile.TemporaryDirectory() as temp:
            for name in ("niche", "specular"):
                subprocess.run([sys.executable, str(HERE / "make_scenes.py"), name, temp, "--scale", "0.4", "--spp", "16"], check=True, capture_output=True)
                found = self.run_check(Path(temp) / name)
                self.assertEqual(found.returncode, 0, found.stdout + found.stderr)
                self.assertNotIn("WRONG", found.stdout)
            folder = Path(temp) / "niche"
            for file, old, new in (("sparse/cameras.txt", "208 208 97.04", "208 208 96.04"), ("truth/lights.json", "9.32", "9.5"), ("project.toml", "gain = 0.00015", "gain = 0.0006"),
                                   ("project.toml", "[0.13,", "[0.2,")):
                whole = (folder / file).read_text()
                self.assertIn(old, whole)
                (folder / file).write_text(whole.replace(old, new))
                self.assertEqual(self.run_check(folder).returncode, 1, "%s: %s was taken for %s" % (file, new, old))
                (folder / file).write_text(whole)


if __name__ == "__main__":
    unittest.main()
