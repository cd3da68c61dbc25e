"""Patterns of albedo over points in space: noise, blocks with joints, tiles, veins. All functions of position and seed alone."""
import numpy as np

_U = np.uint32


def _hash(ix, iy, iz, seed):
    """One well-mixed 32-bit number per lattice point, as a float in [0, 1)."""
    with np.errstate(over="ignore"):
        h = ix.astype(_U) * _U(0x8DA6B343) ^ iy.astype(_U) * _U(0xD8163841) ^ iz.astype(_U) * _U(0xCB1AB31F) ^ _U(seed * 0x9E3779B1 & 0xFFFFFFFF)
        for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
            h = (h ^ (h >> _U(shift))) * _U(factor)
        h = h ^ (h >> _U(16))
    return h.astype(np.float64) / 2.0 ** 32


def noise(p, scale, seed):
    """Value noise in [0, 1], smooth, features of the size `scale` (metres)."""
    q = np.asarray(p, np.float64) / scale
    base = np.floor(q).astype(np.int64)
    f = q - base
    f = f * f * (3 - 2 * f)
    total = np.zeros(len(q))
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                w = (f[:, 0] if i else 1 - f[:, 0]) * (f[:, 1] if j else 1 - f[:, 1]) * (f[:, 2] if k else 1 - f[:, 2])
                total += w * _hash(base[:, 0] + i, base[:, 1] + j, base[:, 2] + k, seed)
    return total


def fractal(p, scale, seed, octaves=4, gain=0.55):
    """Sum of octaves, about [0, 1], mean 0.5."""
    total, weight, norm = np.zeros(len(p)), 1.0, 0.0
    for o in range(octaves):
        total += weight * noise(p, scale / 2 ** o, seed + 101 * o)
        norm += weight
        weight *= gain
    return total / norm


def cell_number(ix, iy, seed):
    """A random number in [0, 1) per cell of a 2-D lattice."""
    return _hash(np.asarray(ix, np.int64), np.asarray(iy, np.int64), np.zeros_like(np.asarray(ix, np.int64)), seed)


def blocks(u, v, width, height, joint, seed):
    """Courses of blocks, each second one shifted by half: (tone per block in [0, 1), 1 within a joint)."""
    row = np.floor(v / height)
    shifted = u + 0.5 * width * (row % 2)
    column = np.floor(shifted / width)
    du = np.minimum(shifted - column * width, (column + 1) * width - shifted)
    dv = np.minimum(v - row * height, (row + 1) * height - v)
    return cell_number(column, row, seed), smooth_step(joint, 0.5 * joint, np.minimum(du, dv))


def smooth_step(a, b, x):
    """0 at a, 1 at b (a may be larger than b)."""
    t = np.clip((x - a) / (b - a), 0, 1)
    return t * t * (3 - 2 * t)


def mix(a, b, t):
    """Colours (N, 3) or (3,) mixed by t (N,)."""
    t = np.asarray(t)[:, None]
    return np.asarray(a) * (1 - t) + np.asarray(b) * t
