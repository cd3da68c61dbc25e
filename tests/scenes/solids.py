"""Signed distances of solids, metres, negative inside. p is (N, 3) float; every function returns (N,).

Distances are exact for spheres, boxes and capsules and lower bounds (never too large by more than the stated trick) for the rest: what
mesh.py needs is the right sign everywhere and a slope near 1 close to the surface.
"""
import numpy as np


def length(v):
    return np.sqrt(np.einsum("ij,ij->i", v, v))


def sphere(p, centre, radius):
    return length(p - np.asarray(centre, p.dtype)) - radius


def ellipsoid(p, centre, radii):
    """First-order distance: f/|grad f|, good near the surface."""
    q = (p - np.asarray(centre, p.dtype)) / np.asarray(radii, p.dtype)
    k0 = length(q)
    k1 = length(q / np.asarray(radii, p.dtype))
    return k0 * (k0 - 1) / np.maximum(k1, 1e-6)


def box(p, centre, half, rounding=0.0):
    q = np.abs(p - np.asarray(centre, p.dtype)) - (np.asarray(half, p.dtype) - rounding)
    return length(np.maximum(q, 0)) + np.minimum(q.max(axis=1), 0) - rounding


def capsule(p, a, b, radius):
    a, b = np.asarray(a, p.dtype), np.asarray(b, p.dtype)
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return length(p - a - t[:, None] * (b - a)) - radius


def cylinder(p, axis, centre, radius, half_height):
    """axis 0, 1 or 2; centre on that axis is the middle."""
    q = p - np.asarray(centre, p.dtype)
    across = np.delete(q, axis, axis=1)
    d = np.stack([length(across) - radius, np.abs(q[:, axis]) - half_height], axis=1)
    return np.minimum(d.max(axis=1), 0) + length(np.maximum(d, 0))


def revolved(p, heights, radii):
    """Solid of revolution about z with a piecewise-linear profile, smoothed a little; distance scaled by the steepest slope."""
    heights, radii = np.asarray(heights, float), np.asarray(radii, float)
    r = np.interp(p[:, 2], heights, radii, left=-1.0, right=-1.0)
    steepest = np.max(np.abs(np.diff(radii) / np.diff(heights)))
    side = (np.hypot(p[:, 0], p[:, 1]) - r) / np.sqrt(1 + steepest ** 2)
    return np.maximum(side, np.maximum(heights[0] - p[:, 2], p[:, 2] - heights[-1])).astype(p.dtype)


def union(*parts):
    return np.minimum.reduce(parts)


def smooth_union(a, b, k):
    """Polynomial blend over a width of k."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h * h * k / 4


def without(a, b):
    """a with b taken away."""
    return np.maximum(a, -b)


def repeated(x, period):
    """x folded into one period about the nearest multiple, and the number of that multiple."""
    n = np.round(x / period)
    return x - n * period, n
