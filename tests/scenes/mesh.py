"""Triangles from a signed distance, by surface nets, and points on them.

Source of the nets: Gibson, "Constrained Elastic Surface Nets", 1998, without the relaxation: a vertex per cell that the surface crosses, moved
onto the surface along the gradient; a quadrilateral per grid edge that it crosses. Edges come out chamfered by about a cell, as stone is.
"""
from dataclasses import dataclass

import numpy as np

BLOCK = 16          # cells a side; blocks further from the surface than their diagonal are not evaluated


@dataclass
class Mesh:
    vertices: np.ndarray    # (V, 3) float32, metres
    faces: np.ndarray       # (F, 3) int32, counter-clockwise seen from outside (positive distance)

    def corners(self):
        return self.vertices[self.faces].astype(np.float64)

    def areas_normals(self):
        a, b, c = self.corners().transpose(1, 0, 2)
        n = np.cross(b - a, c - a)
        twice = np.linalg.norm(n, axis=1)
        return twice / 2, n / np.maximum(twice, 1e-30)[:, None]


def grid_values(distance, low, shape, cell):
    """Distances at the grid's corners; far from the surface only their sign is right. distance may be off by 2x in slope."""
    values = np.empty(shape, np.float32)
    for bx in range(0, shape[0], BLOCK):
        starts = np.stack(np.meshgrid([bx], np.arange(0, shape[1], BLOCK), np.arange(0, shape[2], BLOCK), indexing="ij"), -1).reshape(-1, 3)
        centres = (low + (starts + BLOCK / 2) * cell).astype(np.float32)
        coarse = distance(centres)
        reach = 1.5 * np.sqrt(3) * BLOCK / 2 * cell
        for start, d in zip(starts, coarse):
            cut = tuple(slice(s, min(s + BLOCK, n)) for s, n in zip(start, shape))
            if abs(d) > reach:
                values[cut] = d
                continue
            index = np.stack(np.meshgrid(*[np.arange(c.start, c.stop) for c in cut], indexing="ij"), -1)
            values[cut] = distance((low + index.reshape(-1, 3) * cell).astype(np.float32)).reshape(index.shape[:3])
    return values


def gradient(distance, p, step):
    g = np.empty_like(p)
    for axis in range(3):
        e = np.zeros(3, p.dtype)
        e[axis] = step
        g[:, axis] = (distance(p + e) - distance(p - e)) / (2 * step)
    return g


def surface_net(distance, low, high, cell):
    """Mesh of distance = 0 within the box [low, high]; open where the box cuts the surface."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    shape = tuple(np.ceil((high - low) / cell).astype(int) + 1)
    values = grid_values(distance, low, shape, cell)
    inside = values < 0
    cells = [n - 1 for n in shape]
    corner = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    count = sum(inside[i:i + cells[0], j:j + cells[1], k:k + cells[2]].astype(np.uint8) for i, j, k in corner)
    active = np.argwhere((count > 0) & (count < 8))
    vertex_of_cell = np.full(cells, -1, np.int32)
    vertex_of_cell[tuple(active.T)] = np.arange(len(active))

    # The mean of the crossings of the cell's twelve edges.
    total, number = np.zeros((len(active), 3)), np.zeros(len(active))
    for a in corner:
        for axis in range(3):
            if a[axis]:
                continue
            b = tuple(v + (axis == n) for n, v in enumerate(a))
            va, vb = values[tuple((active + a).T)], values[tuple((active + b).T)]
            crosses = (va < 0) != (vb < 0)
            t = va / np.where(crosses, va - vb, 1)
            at = np.asarray(a, float)[None, :].repeat(len(active), 0)
            at[:, axis] = t
            total += np.where(crosses[:, None], at, 0)
            number += crosses
    start = (low + (active + total / number[:, None]) * cell).astype(np.float32)
    p = start.copy()
    for _ in range(4):
        g = gradient(distance, p, cell / 8)
        p = p - (distance(p) / np.maximum(np.einsum("ij,ij->i", g, g), 0.25))[:, None] * g
        p = start + np.clip(p - start, -cell / 2, cell / 2)

    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        one = inside.take(np.arange(cells[axis]), axis)
        two = inside.take(np.arange(1, cells[axis] + 1), axis)
        for outward in (True, False):   # the surface faces along +axis, or against it
            edge = np.argwhere(one & ~two if outward else ~one & two)
            edge = edge[(edge[:, u] > 0) & (edge[:, v] > 0) & (edge[:, u] < cells[u]) & (edge[:, v] < cells[v])]
            eu, ev = np.zeros(3, int), np.zeros(3, int)
            eu[u], ev[v] = 1, 1
            ring = [edge - eu - ev, edge - ev, edge, edge - eu]
            quad = np.stack([vertex_of_cell[tuple(r.T)] for r in ring], 1)
            quads.append(quad if outward else quad[:, ::-1])
    quad = np.concatenate(quads)
    diagonal = [np.linalg.norm(p[quad[:, a]] - p[quad[:, a + 2]], axis=1) for a in (0, 1)]
    turned = np.where((diagonal[0] <= diagonal[1])[:, None], quad, np.roll(quad, -1, axis=1))
    faces = np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]]).astype(np.int32)
    mesh = Mesh(p.astype(np.float32), faces)
    area, _ = mesh.areas_normals()
    mesh.faces = mesh.faces[area > 1e-4 * cell * cell]
    return mesh


def sample(mesh, number, rng):
    """Random points, uniform by area: face index, barycentric weights (N, 3)."""
    area, _ = mesh.areas_normals()
    total = np.cumsum(area)
    face = np.searchsorted(total, rng.random(number) * total[-1], side="right")
    face = np.minimum(face, len(area) - 1)
    u, v = rng.random(number), rng.random(number)
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return face, np.stack([1 - u - v, u, v], 1)
