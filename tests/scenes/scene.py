"""What a scene is: a solid, its paint, its lights, its photographs. Plain data; scenes.py fills it."""
from dataclasses import dataclass, field
from typing import Callable

import numpy as np


@dataclass
class View:
    """A camera at `eye` that looks at `target`, z up, turned by `roll_deg`. COLMAP axes: x right, y down, z forward."""
    name: str
    eye: tuple
    target: tuple
    roll_deg: float = 0.0
    flash_offset: tuple = (0.13, -0.16, 0.03)      # metres, camera axes
    held_out: bool = False

    def camera_from_world(self):
        """R (3, 3), t (3,) with p_camera = R p_world + t."""
        forward = np.subtract(self.target, self.eye).astype(float)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = np.cos(np.radians(self.roll_deg)), np.sin(np.radians(self.roll_deg))
        r = np.stack([c * right + s * down, -s * right + c * down, forward])
        return r, -r @ np.asarray(self.eye, float)

    def flash_in_world(self):
        r, t = self.camera_from_world()
        return r.T @ (np.asarray(self.flash_offset, float) - t)


@dataclass
class Material:
    """Diffuse where alpha is 0, else Mitsuba's roughplastic with that GGX roughness."""
    alpha: float = 0.0


@dataclass
class Scene:
    name: str
    distance: Callable                  # signed distance of the solid, see solids.py
    low: tuple                          # box that is meshed, metres
    high: tuple
    cell: float                         # edge of the grid's cells, metres
    paint: Callable                     # (p) -> reflectance (N, 3), linear
    views: list
    flash: float                        # W/sr
    ambient: float                      # radiance, uniform and grey
    size: tuple = (480, 360)            # pixels
    focal: float = 520.0
    principal: tuple = (242.6, 177.9)   # pixels, from the corner of the image
    points: int = 150_000
    normals: bool = True                # cloud.ply carries normals
    scan_noise: float = 0.0             # standard deviation per axis, metres
    gain: float = 1e-4                  # photon noise: variance = gain * value + read_sigma^2
    read_sigma: float = 4e-4
    interval: tuple = (0.87, 1.13)      # calibrated flash interval as multiples of the truth
    spp: int = 128
    segments: int = 12                  # of light paths: one more than scatterings
    roulette: int = 5                   # scatterings after which paths may end at random, without bias
    seed: int = 1
    materials: list = field(default_factory=lambda: [Material()])
    material_of: Callable = None        # (p) -> index into materials, (N,)

    def scaled(self, scale):
        """The same scene with `scale` times as many pixels, points and cells a side: for tests and for slow peers."""
        s = Scene(**self.__dict__)
        s.size = tuple(int(round(n * scale)) for n in self.size)
        s.focal = self.focal * scale
        s.principal = tuple(v * scale for v in self.principal)
        s.points = int(self.points * scale * scale)
        s.cell = self.cell / scale
        return s
