#!/usr/bin/env python3
"""The paper's optimisation through Mitsuba 3's differentiable rendering beside chiaro, on one photograph of a scene, all in one run.

    export DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1
    python tests/peers/paper_mitsuba.py SCENE … [--factor 3] [--points 40000] [--spp 8] [--chiaro EXE] [--out DIR]

SCENE is the folder of vplanes (two plates, known by that name) or of a scene made by tests/scenes. Photographs are averaged over FACTOR x FACTOR
pixels, the cloud is thinned to POINTS, and both programs get the same reduced input; geometry for Mitsuba is the true mesh, coarser by FACTOR.

published  one-dimensional search of the flash, 5 values spread geometrically over the calibrated interval, 20 iterations each with albedo and
           ambient free, from the projected photograph; the least loss wins; then 60 iterations with all three free. Adam, rate 0.05, six
           scatterings, lights made grey by averaging and everything clamped after each iteration. Iterations and paths a pixel are ours: the
           paper gives none.
tuned      no search: from the middle of the interval, 160 iterations (as many) with a rate that falls from 0.05 to 0.0005.

Errors are over the same points for every method: those of the reduced cloud that the photograph sees and that each method gives a value.
"""
import argparse
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
import drjit as dr      # noqa: E402

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "scenes"))
import chiaro_runs      # noqa: E402
import mesh as meshing  # noqa: E402
import reduced          # noqa: E402
import render           # noqa: E402
from scene import Scene, View   # noqa: E402
from scenes import SCENES       # noqa: E402

SCATTERINGS, RATE = 6, 0.05
SEARCH_STEPS, SEARCH_ITERATIONS, ITERATIONS = 5, 20, 60
PHOTOGRAPH = "photo_00"


def geometry(name, factor):
    """True surface as a mesh."""
    if name == "vplanes":
        return two_plates(factor * 0.0035)
    scene = SCENES[name]()
    return meshing.surface_net(scene.distance, scene.low, scene.high, scene.cell * factor)


def two_plates(spacing):
    """vplanes: two plates of 1 m x 1 m that meet along the z axis at 80 degrees."""
    n = int(round(1 / spacing))
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij"))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    corner = i * (n + 1) + j
    quads = np.stack([corner, corner + n + 1, corner + n + 2, corner + 1], 1)
    vertices, faces = [], []
    for side in (-1, 1):
        along = np.array([side * np.sin(np.radians(40)), -np.cos(np.radians(40)), 0])
        vertices.append(u[:, None] * along + v[:, None] * [0, 0, 1])
        ordered = quads if side < 0 else quads[:, ::-1]
        faces.append(np.concatenate([ordered[:, [0, 1, 2]], ordered[:, [0, 2, 3]]]) + len(vertices[0]) * (len(vertices) - 1))
    return meshing.Mesh(np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32))


def without_stray_vertices(mesh):
    """Only vertices that a face uses, so that Mitsuba keeps their order."""
    used, renamed = np.unique(mesh.faces, return_inverse=True)
    return meshing.Mesh(mesh.vertices[used], renamed.reshape(-1, 3).astype(np.int32))


class Peer:
    """One photograph, its mesh, and the scene that Mitsuba differentiates."""

    def __init__(self, folder, name, factor):
        self.size, (self.fx, self.fy, self.cx, self.cy), poses = reduced.pinhole(folder)
        self.r, self.t = poses[PHOTOGRAPH]
        self.offset, self.range = reduced.flash_of((folder / "project.toml").read_text())
        self.photo = reduced.read_exr(folder / "photos" / (PHOTOGRAPH + ".exr"))[:, :, :3]
        mask = np.array(mi.Bitmap(str(folder / "masks" / (PHOTOGRAPH + ".png"))))
        self.mask = mask.reshape(mask.shape[:2]) > 127
        self.mesh = without_stray_vertices(geometry(name, factor))
        self.caster = mi.load_dict({"type": "scene", "object": render._plain(self.mesh)}, optimize=False)

    def visible(self, points):
        """(inside the mask and first hit, x, y): x, y in pixels."""
        q = points @ self.r.T + self.t
        x, y = self.fx * q[:, 0] / q[:, 2] + self.cx, self.fy * q[:, 1] / q[:, 2] + self.cy
        w, h = self.size
        inside = (q[:, 2] > 0) & (x > 1) & (x < w - 1) & (y > 1) & (y < h - 1)
        px, py = np.where(inside, x, 1).astype(int), np.where(inside, y, 1).astype(int)
        eye = -self.r.T @ self.t
        d = points - eye
        far = np.linalg.norm(d, axis=1)
        d = d / far[:, None]
        hit = self.caster.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(np.repeat(eye[:, None], len(d), 1).astype(np.float32)), mi.Vector3f(d.T.astype(np.float32))), coherent=False)
        first = np.array(hit.t) > far * 0.995 - 0.003
        return inside & self.mask[py, px] & first, x, y

    def photograph_at(self, x, y):
        fx, fy = x - 0.5, y - 0.5
        ix, iy = np.clip(np.floor(fx).astype(int), 0, self.size[0] - 2), np.clip(np.floor(fy).astype(int), 0, self.size[1] - 2)
        u, v = (fx - ix)[:, None], (fy - iy)[:, None]
        p = self.photo
        return p[iy, ix] * (1 - u) * (1 - v) + p[iy, ix + 1] * u * (1 - v) + p[iy + 1, ix] * (1 - u) * v + p[iy + 1, ix + 1] * u * v

    def projected(self):
        """The paper's start: the photograph on the vertices that it sees, 0.5 elsewhere."""
        seen, x, y = self.visible(self.mesh.vertices.astype(np.float64))
        start = np.full((len(seen), 3), 0.5)
        start[seen] = np.clip(self.photograph_at(x[seen], y[seen]), 0, 1)
        return start

    def scene(self, colour, flash, ambient, spp):
        s = Scene("peer", None, None, None, 1, None, [], 1, 0, size=self.size, focal=self.fx, principal=(self.cx, self.cy))
        view = View("v", (0, 0, 0), (0, 1, 0))
        view.camera_from_world = lambda: (self.r, self.t)
        shape = render._mesh(self.mesh, np.ones(len(self.mesh.faces), bool), colour[self.mesh.faces], s.materials[0])
        shape.set_id("object")
        position = self.r.T @ (self.offset - self.t)
        return mi.load_dict({"type": "scene", "integrator": {"type": "prb", "max_depth": SCATTERINGS + 1, "rr_depth": 1000, "hide_emitters": True},
                             "sensor": render.sensor(s, view, spp), "flash": render.flash_emitter(position, flash), "ambient": render.ambient_emitter(ambient),
                             "object": shape}, optimize=False)

    def at_points(self, colour, points):
        """Colours of the vertices at points near the mesh, interpolated in the nearest triangle along the line of sight."""
        eye = -self.r.T @ self.t
        d = points - eye
        d = d / np.linalg.norm(d, axis=1)[:, None]
        hit = self.caster.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(np.repeat(eye[:, None], len(d), 1).astype(np.float32)), mi.Vector3f(d.T.astype(np.float32))), coherent=False)
        u, v, face = np.array(hit.prim_uv.x), np.array(hit.prim_uv.y), np.array(hit.prim_index)
        c = colour[self.mesh.faces[np.minimum(face, len(self.mesh.faces) - 1)]]
        return c[:, 0] * (1 - u - v)[:, None] + c[:, 1] * u[:, None] + c[:, 2] * v[:, None]


class Optimiser:
    """Adam on the scene's vertex colours, ambient and (unless frozen) flash."""

    def __init__(self, peer, start, flash, flash_free, spp):
        self.peer, self.flash_free, self.spp = peer, flash_free, spp
        self.scene = peer.scene(start, flash, 0.0, spp)
        self.p = mi.traverse(self.scene)
        self.albedo = next(k for k in self.p.keys() if k.endswith("vertex_color"))
        self.flash, self.ambient = "flash.intensity.value", "ambient.radiance.value"
        self.opt = mi.ad.Adam(lr=RATE)
        for key in [self.albedo, self.ambient] + ([self.flash] if flash_free else []):
            self.opt[key] = self.p[key]
        self.p.update(self.opt)
        self.target = mi.TensorXf(peer.photo.astype(np.float32))
        self.weight = mi.TensorXf(np.repeat(peer.mask[:, :, None], 3, 2).astype(np.float32))
        self.count = 3.0 * peer.mask.sum()

    def iterate(self, iterations, seed, rate=lambda k: RATE):
        loss = None
        grey = lambda c: mi.Color3f((c.x + c.y + c.z) / 3)
        for k in range(iterations):
            self.opt.set_learning_rate(rate(k))
            image = mi.render(self.scene, self.p, spp=self.spp, seed=seed + k)
            loss = dr.sum(self.weight * dr.square(image - self.target)) / self.count
            dr.backward(loss)
            self.opt.step()
            self.opt[self.albedo] = dr.clip(self.opt[self.albedo], 0, 1)
            self.opt[self.ambient] = dr.clip(grey(self.opt[self.ambient]), 0, 1)
            if self.flash_free:
                self.opt[self.flash] = dr.clip(grey(self.opt[self.flash]), *self.peer.range)
            self.p.update(self.opt)
        return float(np.array(loss).reshape(-1)[0])

    def result(self):
        number = lambda key: float(np.array(self.p[key]).reshape(-1)[0])
        return np.array(self.p[self.albedo]).reshape(-1, 3), number(self.flash), number(self.ambient)


def published(peer, spp):
    low, high = peer.range
    best, losses = None, []
    for step in range(SEARCH_STEPS):
        flash = low * (high / low) ** (step / (SEARCH_STEPS - 1))
        search = Optimiser(peer, peer.projected(), flash, False, spp)
        losses.append(search.iterate(SEARCH_ITERATIONS, 1000 * step))
        if best is None or losses[-1] < best[0]:
            best = (losses[-1], search.result())
    albedo, flash, ambient = best[1]
    final = Optimiser(peer, albedo, flash, True, spp)
    final.p[final.ambient] = mi.Color3f(ambient)
    final.opt[final.ambient] = final.p[final.ambient]
    final.p.update(final.opt)
    loss = final.iterate(ITERATIONS, 100_000)
    return final.result(), {"search_losses": losses, "loss": loss}


def tuned(peer, spp):
    total = SEARCH_STEPS * SEARCH_ITERATIONS + ITERATIONS
    run = Optimiser(peer, peer.projected(), 0.5 * sum(peer.range), True, spp)
    loss = run.iterate(total, 200_000, lambda k: RATE * 0.01 ** (k / (total - 1)))
    return run.result(), {"loss": loss}


def work(folder, name, factor, method, spp, out):
    """The child process of one method, so that its time and memory are its own."""
    peer = Peer(folder, name, factor)
    (albedo, flash, ambient), extra = {"published": published, "tuned": tuned}[method](peer, spp)
    cloud = chiaro_runs.read_ply(folder / "cloud.ply")
    points = np.stack([cloud["x"], cloud["y"], cloud["z"]], 1).astype(np.float64)
    np.savez(out, albedo=peer.at_points(albedo, points), flash=flash, ambient=ambient, extra=json.dumps(extra))


def line(title, albedo, truth, lights, true_lights, core, peak):
    error, scaled = chiaro_runs.albedo_errors(albedo, truth)
    shown = ["%+.1f" % (100 * np.log(l / t)) if l > 0 else "none" for l, t in zip(lights, true_lights)]
    return "| %s | %.1f / %.1f | %.1f / %.1f | %s | %s | %.1f | %.0f |" % (title, *error, *scaled, *shown, core, peak)


def by_mitsuba(options, folder, name, base, method):
    """(albedo at all points, (flash, ambient), core-seconds, peak MiB, what else it says)."""
    found = base / (method + ".npz")
    log = base / "log.txt"
    code, core, peak = chiaro_runs.timed([sys.executable, __file__, "--work", method, str(folder), name, str(options.factor), str(options.spp), str(found)], log)
    if code:
        sys.exit("error: %s on %s ended with %d, see %s" % (method, name, code, log))
    r = np.load(found)
    return r["albedo"], (float(r["flash"]), float(r["ambient"])), core, peak, json.loads(str(r["extra"]))


def by_chiaro(options, folder, base, method, true_lights):
    out = base / ("chiaro." + method)
    shutil.rmtree(out, ignore_errors=True)
    outcome = chiaro_runs.run(options.chiaro, folder / "project.toml", out, method, base / "log.txt")
    if outcome.note:
        sys.exit("error: chiaro, %s: %s, see %s" % (method, outcome.note, base / "log.txt"))
    ply = chiaro_runs.read_ply(out / "albedo.ply")
    lights = np.exp(outcome.lights[0][0]) * true_lights[0], np.exp(outcome.lights[0][2]) * true_lights[1]
    return np.stack([ply["albedo_" + c] for c in "rgb"], 1).astype(np.float64), lights, outcome.core_seconds, outcome.peak_mib, {}


def compare(options, source):
    name = source.resolve().name
    taken = [PHOTOGRAPH] if name == "vplanes" else sorted(p.stem for p in (source / "photos").glob("*.exr"))
    base = options.out / name
    base.mkdir(parents=True, exist_ok=True)
    one = base / "one"
    reduced.reduce(source, one, options.factor, options.points, [PHOTOGRAPH])
    record = json.loads((one / "truth/lights.json").read_text())
    true_lights = record["flash_intensity_w_per_sr"], record["ambient_radiance"]
    results = {"paper through Mitsuba, " + m: by_mitsuba(options, one, name, base, m) for m in ("published", "tuned")}
    results.update({"chiaro " + m: by_chiaro(options, one, base, m, true_lights) for m in ("adam", "single", "direct")})
    if len(taken) > 1:
        reduced.reduce(source, base / "all", options.factor, options.points, taken)
        results["chiaro joint, %d photographs" % len(taken)] = by_chiaro(options, base / "all", base, "joint", true_lights)

    peer = Peer(one, name, options.factor)
    cloud = chiaro_runs.read_ply(one / "cloud.ply")
    seen, _, _ = peer.visible(np.stack([cloud["x"], cloud["y"], cloud["z"]], 1).astype(np.float64))
    common = seen.copy()
    for albedo, *_ in results.values():
        common &= np.isfinite(albedo).all(axis=1)
    truth = np.load(one / "truth/albedo.npy").astype(np.float64)[common]
    print("\n%s: %s at %d x %d, %d vertices, %d paths a pixel; errors over the %d points that all methods value, of %d that the photograph sees" %
          (name, PHOTOGRAPH, *peer.size, len(peer.mesh.vertices), options.spp, common.sum(), seen.sum()))
    print("| method | albedo error, mean / median, % | after one factor, % | ln Lp error, % | ln La error, % | core-s | peak MiB |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for title, (albedo, lights, core, peak, _) in results.items():
        print(line(title, albedo[common], truth, lights, true_lights, core, peak))
    losses = results["paper through Mitsuba, published"][4]["search_losses"]
    print("published: loss at the end of each search step, from low to high flash: " + " ".join("%.3g" % v for v in losses), flush=True)


def main():
    if sys.argv[1:2] == ["--work"]:
        method, folder, name, factor, spp, out = sys.argv[2:]
        return work(Path(folder), name, int(factor), method, int(spp), out)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--factor", type=int, default=3)
    parser.add_argument("--points", type=int, default=40_000)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--chiaro", type=Path, default=HERE.parents[1] / "build/release/chiaro")
    parser.add_argument("--out", type=Path, default=Path("peers.out"))
    options = parser.parse_args()
    for source in options.scenes:
        compare(options, source)


if __name__ == "__main__":
    main()
