#!/usr/bin/env python3
"""Reference gradients of the paper's loss from Mitsuba's path replay, on a scene small enough to be written down in a test.

    export DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1
    python tests/peers/gradients_mitsuba.py [--rounds 24] [--spp 256]

The scene: a floor (z = 0, normal +z) and a wall (x = 0, normal +x), both 1 m x 1 m with y in 0..1, each in two halves (y below, above 0.5) of one
albedo; a flash at FLASH of LP W/sr; a uniform sky LA; six scatterings. The loss is the mean over area and channels of (radiance - TARGET)^2:
    dL/d(albedo of a half, channel), dL/dLp, dL/dLa
By orthographic cameras that look at each plate along its normal, so that the mean over pixels is the mean over area. mi.render draws the image and
its gradient from different random numbers, so noise leaves no bias. Prints means and standard errors over the rounds, and beside them central
differences of an unbiased loss, (image - TARGET) of two independent renders multiplied. What to compare in chiaro: optimize/adam.h, adam_loss()
with surfels spread evenly over both plates, each of them seen, Observation::radiosity = pi * TARGET; gradients of the surfels of a half added up.
"""
import argparse

import numpy as np
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
import drjit as dr      # noqa: E402

FLASH, LP, LA, TARGET, SCATTERINGS = (0.9, 0.4, 1.2), 3.0, 0.2, 0.25, 6
ALBEDO = {"floor_low": (0.7, 0.5, 0.3), "floor_high": (0.4, 0.6, 0.2), "wall_low": (0.5, 0.55, 0.6), "wall_high": (0.2, 0.3, 0.8)}
PIXELS = 64


def half_plate(name):
    """Mitsuba's rectangle covers -1..1 in x and y with the normal +z."""
    t = mi.ScalarTransform4f
    y = 0.25 if name.endswith("low") else 0.75
    if name.startswith("floor"):
        place = t().translate([0.5, y, 0]).scale([0.5, 0.25, 1])
    else:
        place = t().translate([0, y, 0.5]).rotate([0, 1, 0], 90).scale([0.5, 0.25, 1])
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "twosided", "b": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(ALBEDO[name])}}}}


def camera(plate):
    t = mi.ScalarTransform4f
    if plate == "floor":
        look = t().look_at(origin=[0.5, 0.5, 3], target=[0.5, 0.5, 0], up=[0, 1, 0])
    else:
        look = t().look_at(origin=[3, 0.5, 0.5], target=[0, 0.5, 0.5], up=[0, 1, 0])
    return {"type": "orthographic", "near_clip": 0.1, "far_clip": 10, "to_world": look.scale([0.5, 0.5, 1]),
            "film": {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "pixel_format": "rgb", "component_format": "float32", "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"}}


def scene():
    return mi.load_dict({"type": "scene", "integrator": {"type": "prb", "max_depth": SCATTERINGS + 1, "rr_depth": 1000}, "floor_camera": camera("floor"), "wall_camera": camera("wall"),
                         "flash": {"type": "point", "position": list(FLASH), "intensity": {"type": "rgb", "value": [LP] * 3}},
                         "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [LA] * 3}}, **{n: half_plate(n) for n in ALBEDO}}, optimize=False)


def keys(p):
    found = {n: next(k for k in p.keys() if k.startswith(n) and k.endswith("reflectance.value")) for n in ALBEDO}
    return {**found, "flash": "flash.intensity.value", "sky": "sky.radiance.value"}


def gradient(s, p, names, spp, seed):
    """{name: 3 numbers}, of the loss with the renders' seeds from `seed` on."""
    for key in names.values():
        dr.enable_grad(p[key])
    p.update()
    loss = 0
    for n in (0, 1):
        image = mi.render(s, p, sensor=n, spp=spp, seed=2 * seed + n)
        loss += dr.mean(dr.square(image - TARGET), axis=None) / 2
    dr.backward(loss)
    found = {n: np.array(dr.grad(p[k])).reshape(-1).astype(float) for n, k in names.items()}
    for key in names.values():
        dr.disable_grad(p[key])
    return found


def loss(s, spp, seed):
    """Unbiased: the product of two independent renders' differences from the target."""
    total = 0.0
    for n in (0, 1):
        one, two = (np.array(mi.render(s, sensor=n, spp=spp, seed=4 * seed + 2 * n + k + 500_000), np.float64) for k in (0, 1))
        total += np.mean((one - TARGET) * (two - TARGET)) / 2
    return total


def difference(s, p, key, index, step, spp, seed):
    """Central difference with the same random numbers on both sides. index None: all channels at once (grey lights)."""
    start = mi.Color3f(p[key])
    ends = []
    for sign in (1, -1):
        value = np.array(start).reshape(-1)
        if index is None:
            value = value + sign * step
        else:
            value[index] += sign * step
        p[key] = mi.Color3f(*[float(v) for v in value])
        p.update()
        ends.append(loss(s, spp, seed))
    p[key] = start
    p.update()
    return (ends[0] - ends[1]) / (2 * step)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=24, help="renders averaged; a quarter as many for the differences")
    parser.add_argument("--spp", type=int, default=256)
    options = parser.parse_args()
    s = scene()
    p = mi.traverse(s)
    names = keys(p)
    rounds = [gradient(s, p, names, options.spp, n) for n in range(options.rounds)]
    print("loss %.6f" % np.mean([loss(s, options.spp, n) for n in range(4)]))
    print("%-22s %12s %10s %14s %10s" % ("", "dL/dx", "std. err.", "difference", "std. err."))
    for name, key in names.items():
        values = np.array([r[name] for r in rounds])
        lights = name in ("flash", "sky")
        # Lights are grey: their derivative is the sum over the channels.
        values = values.sum(axis=1, keepdims=True) if lights else values
        for c in range(values.shape[1]):
            step = 0.02 * (LP if name == "flash" else LA if name == "sky" else ALBEDO[name][c])
            check = [difference(s, p, key, None if lights else c, step, options.spp, n) for n in range(max(2, options.rounds // 4))]
            print("%-22s %12.6f %10.6f %14.6f %10.6f" % ("%s%s" % (name, "" if lights else " " + "rgb"[c]), *mean_error(values[:, c]), *mean_error(check)), flush=True)


def mean_error(values):
    return np.mean(values), np.std(values, ddof=1) / np.sqrt(len(values))


if __name__ == "__main__":
    main()
