"""The scenes by name. Shapes and paint are made up; nothing shows a real object."""
import numpy as np

import paint as pt
import solids as sd
from scene import Material, Scene, View


# --- niche: an arched wall niche with a bust on a socle, a moulding, a ledge, a tiled floor -------------------------------------------------------

def _curls(seed):
    """Small spheres all over the top and the back of the head."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < 60:
        d = rng.normal(size=3)
        d /= np.linalg.norm(d)
        if d[2] > 0.15 or (d[1] > 0.2 and d[2] > -0.6):
            found.append((np.array([0.0, 0.16, 1.315]) + d * [0.098, 0.118, 0.128], rng.uniform(0.022, 0.036)))
    return found


def _bust(p):
    body = sd.ellipsoid(p, (0, 0.2, 0.86), (0.225, 0.14, 0.24))
    shoulders = sd.capsule(p, (-0.2, 0.21, 0.98), (0.2, 0.21, 0.98), 0.085)
    body = sd.smooth_union(body, shoulders, 0.1)
    body = sd.smooth_union(body, sd.capsule(p, (0, 0.2, 1.0), (0, 0.17, 1.22), 0.06), 0.07)
    folds = 0.012 * np.sin(26 * p[:, 0] + 14 * p[:, 2]) * np.clip((1.0 - p[:, 2]) / 0.2, 0, 1)
    body = body + folds.astype(p.dtype)
    head = sd.ellipsoid(p, (0, 0.15, 1.31), (0.095, 0.115, 0.135))
    head = sd.smooth_union(head, sd.capsule(p, (0, 0.045, 1.335), (0, 0.02, 1.285), 0.014), 0.02)
    head = sd.without(head, sd.union(sd.sphere(p, (-0.04, 0.043, 1.33), 0.02), sd.sphere(p, (0.04, 0.043, 1.33), 0.02)))
    for centre, radius in _curls(5):
        near = sd.sphere(p, centre, radius)
        head = sd.smooth_union(head, near, 0.015)
    return sd.smooth_union(body, head, 0.04)


def _niche_parts(p):
    wall = -p[:, 1]
    hollow = sd.union(sd.cylinder(p, 2, (0, 0, 0.93), 0.55, 0.6), sd.sphere(p, (0, 0, 1.53), 0.55))
    wall = sd.without(wall, hollow)
    ring = np.hypot(np.hypot(p[:, 0], np.maximum(p[:, 2] - 1.53, 0)) - 0.63, p[:, 1]) - 0.055
    moulding = np.maximum(ring, 0.34 - p[:, 2])
    ledge = sd.box(p, (0, -0.02, 0.27), (0.78, 0.12, 0.06), 0.015)
    floor = p[:, 2]
    socle = sd.box(p, (0, 0.2, 0.47), (0.2, 0.17, 0.14), 0.02)
    torus = np.hypot(np.hypot(p[:, 0], p[:, 1] - 0.2) - 0.12, p[:, 2] - 0.62) - 0.028
    return [wall, np.minimum(moulding, ledge), floor, np.minimum(socle, torus), _bust(p)]


def _niche_distance(p):
    return np.minimum.reduce(_niche_parts(p)).astype(np.float32)


def _niche_paint(p):
    part = np.argmin(np.stack(_niche_parts(p.astype(np.float32))), axis=0)
    grain = pt.fractal(p, 0.12, 11)
    fine = pt.fractal(p, 0.025, 12, 3)
    tone, joint = pt.blocks(p[:, 0], p[:, 2] - 0.05, 0.42, 0.21, 0.012, 13)
    wall = pt.mix((0.62, 0.52, 0.38), (0.74, 0.66, 0.53), tone) * (0.75 + 0.5 * grain)[:, None]
    wall = pt.mix(wall, (0.16, 0.14, 0.12), joint)
    wall = pt.mix(wall, (0.2, 0.23, 0.13), 0.7 * pt.smooth_step(0.6, 0.75, pt.fractal(p, 0.35, 14)))
    inside = (p[:, 1] > 0.02) & (part == 0)
    stars = pt.smooth_step(0.030, 0.022, _star_distance(p))
    blue = pt.mix(np.tile((0.22, 0.34, 0.6), (len(p), 1)) * (0.6 + 0.8 * grain)[:, None], (0.72, 0.55, 0.16), stars)
    wall = np.where(inside[:, None], blue, wall)
    marble = pt.mix((0.80, 0.77, 0.72), (0.46, 0.44, 0.47), pt.smooth_step(0.42, 0.5, pt.fractal(p, 0.2, 15)) * pt.smooth_step(0.58, 0.5, pt.fractal(p, 0.2, 15)))
    hair = (np.linalg.norm((p - [0, 0.16, 1.315]) / [0.11, 0.13, 0.145], axis=1) > 0.93) & (p[:, 2] > 1.26) & ((p[:, 2] > 1.4) | (p[:, 1] > 0.13))
    marble = np.where(hair[:, None], (0.42, 0.2, 0.11), marble) * (0.85 + 0.3 * fine)[:, None]
    serpentine = pt.mix((0.07, 0.2, 0.12), (0.35, 0.5, 0.33), pt.smooth_step(0.55, 0.7, pt.fractal(p, 0.06, 16, 3)))
    gilt = pt.mix((0.58, 0.43, 0.2), (0.3, 0.2, 0.1), grain)
    _, seam = pt.blocks(p[:, 0] + 5, p[:, 1] + 5, 0.3, 0.3, 0.01, 17)
    odd = (np.floor(p[:, 0] / 0.3) + np.floor(p[:, 1] / 0.3)) % 2
    tiles = np.where(odd[:, None] > 0, (0.55, 0.25, 0.18), (0.68, 0.64, 0.56)) * (0.7 + 0.6 * fine)[:, None]
    tiles = pt.mix(tiles, (0.25, 0.23, 0.2), seam)
    colour = np.stack([wall, gilt, tiles, serpentine, marble])[part, np.arange(len(p))]
    return np.clip(colour, 0.03, 0.9)


def _star_distance(p):
    """Distance to the nearest star of the painted sky, on the niche's unrolled surface."""
    row = np.round(p[:, 2] / 0.14)
    u, _ = sd.repeated(np.arctan2(p[:, 0], p[:, 1]) * 0.55 + 0.07 * (row % 2), 0.14)
    return np.hypot(u, p[:, 2] - row * 0.14)


def niche():
    aim = (0, 0.1, 1.0)
    views = [View("photo_00", (-1.1, -2.5, 1.35), aim, 2), View("photo_01", (0.1, -2.9, 1.0), (0.02, 0.1, 1.02), -1),
             View("photo_02", (1.35, -2.3, 1.15), aim, 0), View("photo_03", (0.6, -2.5, 1.9), (0, 0.1, 0.98), -3),
             View("photo_04", (-0.45, -1.25, 1.25), (0.02, 0.15, 1.08), 4), View("photo_05", (0.55, -1.2, 0.95), (-0.02, 0.15, 0.9), 0),
             View("novel_00", (-0.5, -2.6, 1.2), aim, 0, (-0.4, -0.3, 0.05), True), View("novel_01", (0.35, -1.5, 1.15), (0, 0.1, 1.1), 1, (0.55, -0.05, 0.0), True)]
    return Scene("niche", _niche_distance, (-0.98, -0.75, -0.05), (0.98, 0.62, 2.3), 0.0055, _niche_paint, views, flash=9.32, ambient=0.048,
                 points=180_000, gain=1.5e-4, read_sigma=5e-4, interval=(0.915, 1.19), seed=21)


# --- crypt: a small barrel-vaulted room with coffers, two columns, a bench; one door and one round window let the day in; seen from inside ---------

_R, _SPRING, _LENGTH = 1.2, 1.35, 2.0    # radius of the vault, height of its spring, half length


def _crypt_air(p):
    x, y, z = p[:, 0], p[:, 1], p[:, 2]
    room = sd.box(p, (0, 0, _SPRING / 2), (_R, _LENGTH, _SPRING / 2))
    radius = np.hypot(x, z - _SPRING)
    vault = np.maximum(radius - _R, np.maximum(np.abs(y) - _LENGTH, _SPRING - 0.01 - z))
    angle, _ = sd.repeated(np.arctan2(x, z - _SPRING), np.radians(25.7))
    along, _ = sd.repeated(y, 0.5)
    coffer = np.maximum(np.maximum(np.abs(angle) * _R - 0.17, np.abs(along) - 0.17), radius - _R - 0.08)
    coffer = np.maximum(coffer, np.maximum(np.abs(y) - _LENGTH + 0.25, _SPRING + 0.1 - z))
    door = sd.union(sd.box(p, (0.35, _LENGTH + 0.2, 0.65), (0.36, 0.4, 0.65)), sd.cylinder(p, 1, (0.35, _LENGTH + 0.2, 1.3), 0.36, 0.4))
    window = sd.cylinder(p, 1, (-0.1, -_LENGTH - 0.2, 1.85), 0.24, 0.4)
    return sd.union(room, vault, coffer, door, window)


def _crypt_parts(p):
    shell = -_crypt_air(p)
    things = []
    for cx in (-0.62, 0.68):
        shaft = sd.cylinder(p, 2, (cx, 0.15, 0.9), 0.11, 1.25) + 0.008 * np.cos(10 * np.arctan2(p[:, 1] - 0.15, p[:, 0] - cx)).astype(p.dtype)
        capital = sd.box(p, (cx, 0.15, 1.42), (0.17, 0.17, 0.07), 0.03)
        base = sd.union(sd.box(p, (cx, 0.15, 0.05), (0.19, 0.19, 0.06), 0.01), np.hypot(np.hypot(p[:, 0] - cx, p[:, 1] - 0.15) - 0.12, p[:, 2] - 0.14) - 0.04)
        things += [shaft, np.minimum(capital, base)]
    bench = sd.box(p, (-_R, -0.7, 0.2), (0.32, 0.8, 0.21), 0.02)
    return [shell, np.minimum(things[0], things[2]), np.minimum(things[1], things[3]), bench]


def _crypt_distance(p):
    return np.minimum.reduce(_crypt_parts(p)).astype(np.float32)


def _crypt_paint(p):
    x, y, z = p.T
    part = np.argmin(np.stack(_crypt_parts(p.astype(np.float32))), axis=0)
    grain, large = pt.fractal(p, 0.2, 31), pt.fractal(p, 0.6, 32)
    fine = pt.fractal(p, 0.05, 33, 3)
    plaster = pt.mix((0.72, 0.66, 0.52), (0.55, 0.46, 0.34), pt.smooth_step(0.45, 0.62, large)) * (0.8 + 0.4 * grain)[:, None]
    dado = np.tile((0.45, 0.11, 0.08), (len(p), 1)) * (0.7 + 0.6 * grain)[:, None]
    along = np.where(np.abs(np.abs(x) - _R) < 0.1, y, x)
    u, _ = sd.repeated(along, 0.2)
    zigzag = pt.smooth_step(0.012, 0.008, np.abs(z - 0.78 - 0.5 * np.abs(u)))
    wall = np.where((z < 0.75)[:, None], dado, plaster)
    wall = pt.mix(wall, (0.78, 0.6, 0.2), np.maximum(zigzag, pt.smooth_step(0.014, 0.01, np.abs(z - 0.72))))
    radius = np.hypot(x, z - _SPRING)
    sky = pt.mix((0.12, 0.25, 0.42), (0.25, 0.45, 0.5), grain)
    rib = pt.mix((0.66, 0.55, 0.36), (0.5, 0.36, 0.2), fine)
    vault = pt.mix(rib, sky, pt.smooth_step(_R + 0.02, _R + 0.05, radius))
    wall = np.where(((z > _SPRING + 0.02) & (radius > _R - 0.02) & (np.abs(y) < _LENGTH - 0.02))[:, None], vault, wall)
    tone, joint = pt.blocks(x, y, 0.34, 0.26, 0.012, 34)
    floor = pt.mix(pt.mix((0.42, 0.36, 0.3), (0.58, 0.5, 0.4), tone) * (0.75 + 0.5 * fine)[:, None], (0.12, 0.11, 0.1), joint)
    wall = np.where((z < 0.012)[:, None], floor, wall)
    vein = pt.fractal(p, 0.25, 35)
    column = pt.mix((0.66, 0.63, 0.6), (0.3, 0.26, 0.28), pt.smooth_step(0.44, 0.5, vein) * pt.smooth_step(0.56, 0.5, vein)) * (0.85 + 0.3 * fine)[:, None]
    stone = np.tile((0.7, 0.64, 0.5), (len(p), 1)) * (0.75 + 0.5 * grain)[:, None]
    bench = pt.mix((0.3, 0.36, 0.2), (0.55, 0.52, 0.36), pt.smooth_step(0.4, 0.6, grain))
    colour = np.stack([wall, column, stone, bench])[part, np.arange(len(p))]
    return np.clip(colour, 0.03, 0.9)


def crypt():
    views = [View("photo_00", (0.15, -1.35, 1.25), (0.1, 1.8, 1.15), 1), View("photo_01", (-0.55, 1.4, 1.25), (0.35, -1.0, 1.0), -2),
             View("photo_02", (0.6, -1.2, 1.05), (-0.9, 0.6, 0.9), 0), View("photo_03", (0.0, 1.0, 1.0), (-0.2, -0.6, 2.4), 3),
             View("photo_04", (-0.1, -1.1, 1.15), (0.1, 0.6, 2.35), 0), View("photo_05", (0.55, 1.3, 1.3), (-0.9, -0.7, 0.45), 2),
             View("photo_06", (-0.3, 0.85, 1.3), (1.1, -0.8, 0.6), 0),
             View("novel_00", (-0.4, -1.3, 1.2), (0.6, 0.9, 1.3), 0, (-0.3, -0.2, 0.1), True), View("novel_01", (0.25, 1.4, 1.1), (-0.5, -0.8, 1.2), 0, (0.3, -0.1, 0.0), True)]
    return Scene("crypt", _crypt_distance, (-1.45, -2.25, -0.12), (1.4, 2.25, 2.75), 0.01, _crypt_paint, views, flash=2.61, ambient=1.08,
                 size=(288, 216), focal=200.0, principal=(142.3, 109.5), points=200_000, normals=False, scan_noise=0.0007, gain=1e-3, read_sigma=8e-4,
                 interval=(0.84, 1.08), spp=96, segments=10, roulette=3, seed=22)


# --- specular: a glazed vase, a polished ball and a waxed box on a slab before a curved, rough wall -------------------------------------------------

def _vase(p):
    q = p - np.asarray((-0.16, 0.0, 0.0), p.dtype)
    body = sd.revolved(q, [0.08, 0.1, 0.16, 0.24, 0.34, 0.44, 0.53, 0.6, 0.66, 0.7, 0.72], [0.09, 0.11, 0.085, 0.14, 0.19, 0.2, 0.165, 0.1, 0.075, 0.09, 0.1])
    around = np.arctan2(q[:, 1], q[:, 0])
    return body + (0.006 * np.cos(14 * around) * np.clip((0.5 - np.abs(q[:, 2] - 0.36) * 2.5), 0, 1)).astype(p.dtype)


def _specular_parts(p):
    slab = sd.box(p, (0, 0, 0.03), (0.62, 0.42, 0.05), 0.012)
    ball = sd.sphere(p, (0.26, -0.12, 0.225), 0.145)
    q = p - np.asarray((0.3, 0.2, 0.26), p.dtype)
    c, s = np.cos(0.5), np.sin(0.5)
    q = np.stack([c * q[:, 0] + s * q[:, 1], -s * q[:, 0] + c * q[:, 1], q[:, 2]], 1)
    chest = sd.box(q, (0, 0, 0), (0.13, 0.1, 0.18), 0.015)
    wall = 1.0 - np.hypot(p[:, 0], p[:, 1] + 0.45)
    return [wall, slab, _vase(p), ball, chest]


def _specular_distance(p):
    return np.minimum.reduce(_specular_parts(p)).astype(np.float32)


def _specular_part(p):
    return np.argmin(np.stack(_specular_parts(p.astype(np.float32))), axis=0)


def _specular_paint(p):
    part = _specular_part(p)
    grain, fine = pt.fractal(p, 0.1, 41), pt.fractal(p, 0.03, 42, 3)
    tone, joint = pt.blocks(np.arctan2(p[:, 0], p[:, 1] + 0.45), p[:, 2], 0.24, 0.16, 0.008, 43)
    wall = pt.mix(pt.mix((0.5, 0.44, 0.34), (0.62, 0.58, 0.5), tone) * (0.8 + 0.4 * grain)[:, None], (0.2, 0.18, 0.15), joint)
    slab = pt.mix((0.12, 0.13, 0.14), (0.32, 0.3, 0.3), pt.smooth_step(0.4, 0.65, grain))
    angle = np.arctan2(p[:, 1], p[:, 0] + 0.16)
    wave = np.sin(8 * angle) * 0.03
    band = pt.smooth_step(0.05, 0.042, np.abs(p[:, 2] - 0.4 - wave))
    vase = pt.mix(np.tile((0.66, 0.6, 0.5), (len(p), 1)) * (0.85 + 0.3 * fine)[:, None], (0.08, 0.17, 0.42), band)
    vase = pt.mix(vase, (0.5, 0.2, 0.07), pt.smooth_step(0.6, 0.62, p[:, 2]))
    ball = pt.mix((0.48, 0.12, 0.08), (0.3, 0.07, 0.06), pt.smooth_step(0.45, 0.6, grain))
    ring = pt.smooth_step(0.5, 0.3, np.abs(np.sin(45 * (np.hypot(p[:, 0], p[:, 1]) + 0.03 * pt.noise(p, 0.1, 44)))))
    chest = pt.mix((0.36, 0.2, 0.09), (0.18, 0.09, 0.04), 0.7 * ring)
    return np.clip(np.stack([wall, slab, vase, ball, chest])[part, np.arange(len(p))], 0.03, 0.9)


def specular():
    aim = (0.02, 0.05, 0.3)
    views = [View("photo_00", (-0.75, -1.6, 0.75), aim, 0), View("photo_01", (-0.15, -1.75, 0.55), aim, 2), View("photo_02", (0.5, -1.65, 0.65), aim, -2),
             View("photo_03", (1.05, -1.25, 0.9), aim, 0), View("photo_04", (0.1, -1.5, 1.15), aim, 1), View("photo_05", (-0.4, -1.05, 0.6), (0, 0.02, 0.28), 0),
             View("photo_06", (0.45, -1.0, 0.45), (0.05, 0.02, 0.28), -1),
             View("novel_00", (-0.3, -1.55, 0.85), aim, 0, (-0.4, -0.25, 0.05), True), View("novel_01", (0.6, -1.3, 0.6), aim, 0, (0.5, -0.1, 0.0), True)]
    return Scene("specular", _specular_distance, (-0.8, -0.46, -0.015), (0.8, 0.6, 1.0), 0.0033, _specular_paint, views, flash=4.71, ambient=0.11,
                 focal=560.0, points=160_000, interval=(0.82, 1.07), seed=23,
                 materials=[Material(0.4), Material(0.3), Material(0.15), Material(0.2), Material(0.25)], material_of=_specular_part)


SCENES = {"niche": niche, "crypt": crypt, "specular": specular}
