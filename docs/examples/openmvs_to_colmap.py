#!/usr/bin/env python3
"""Cameras of an OpenMVS scene (.mvs, interface versions 1 to 6) as a COLMAP text folder, which chiaro reads.

usage: openmvs_to_colmap.py scene.mvs FOLDER

OpenMVS counts pixel centres from 0, COLMAP from 0.5; its pose is x_camera = R (x_world - C). Undistorted pinhole cameras only, as OpenMVS has them.
"""
import os
import struct
import sys


class Reader:
    def __init__(self, data):
        self.data, self.at = data, 0

    def values(self, form):
        found = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return found

    def count(self):
        n = self.values("Q")[0]
        if n > len(self.data):
            raise ValueError(f"offset {self.at}: a count of {n} does not fit the file")
        return n

    def text(self):
        n = self.count()
        self.at += n
        return self.data[self.at - n:self.at].decode()


def read_scene(data):
    """The platforms, each with its cameras (width, height, K) and poses (R, C), and the images (name, platform, camera, pose)."""
    if data[:4] != b"MVSI":
        raise ValueError("not an OpenMVS scene: it does not begin with MVSI")
    r = Reader(data)
    r.at = 4
    version = r.values("II")[0]
    platforms = []
    for _ in range(r.count()):
        r.text()
        cameras, poses = [], []
        for _ in range(r.count()):
            r.text()
            if version > 3:
                r.text()
            width, height = r.values("II") if version > 0 else (0, 0)
            k = r.values("9d")
            r.values("12d")
            cameras.append((width, height, k))
        for _ in range(r.count()):
            poses.append((r.values("9d"), r.values("3d")))
        platforms.append((cameras, poses))
    images = []
    for _ in range(r.count()):
        name = r.text()
        if version > 4:
            r.text()
        platform, camera, pose = r.values("III")
        if version > 2:
            r.values("I")
        images.append((name, platform, camera, pose))
    return platforms, images


def quaternion(r):
    """w, x, y, z of a rotation matrix in rows."""
    trace = r[0] + r[4] + r[8]
    candidates = [trace, r[0], r[4], r[8]]
    largest = candidates.index(max(candidates))
    s = 2 * (max(1 + (trace if largest == 0 else 2 * candidates[largest] - trace), 0)) ** 0.5
    if largest == 0:
        return s / 4, (r[7] - r[5]) / s, (r[2] - r[6]) / s, (r[3] - r[1]) / s
    if largest == 1:
        return (r[7] - r[5]) / s, s / 4, (r[1] + r[3]) / s, (r[2] + r[6]) / s
    if largest == 2:
        return (r[2] - r[6]) / s, (r[1] + r[3]) / s, s / 4, (r[5] + r[7]) / s
    return (r[3] - r[1]) / s, (r[2] + r[6]) / s, (r[5] + r[7]) / s, s / 4


def main(scene, folder):
    with open(scene, "rb") as file:
        platforms, images = read_scene(file.read())
    os.makedirs(folder, exist_ok=True)
    ids = {}
    with open(os.path.join(folder, "cameras.txt"), "w") as out:
        for p, (cameras, _) in enumerate(platforms):
            for c, (width, height, k) in enumerate(cameras):
                ids[p, c] = len(ids) + 1
                out.write(f"{ids[p, c]} PINHOLE {width} {height} {k[0]!r} {k[4]!r} {k[2] + 0.5!r} {k[5] + 0.5!r}\n")
    with open(os.path.join(folder, "images.txt"), "w") as out:
        number = 0
        for name, p, c, pose in images:
            poses = platforms[p][1]
            if pose >= len(poses):
                continue  # not aligned
            r, centre = poses[pose]
            t = [-sum(r[3 * i + j] * centre[j] for j in range(3)) for i in range(3)]
            number += 1
            numbers = " ".join(repr(v) for v in (*quaternion(r), *t))
            out.write(f"{number} {numbers} {ids[p, c]} {os.path.basename(name)}\n\n")
    open(os.path.join(folder, "points3D.txt"), "w").close()
    print(f"{number} cameras in {folder}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2])
