#!/usr/bin/env python3
"""Reference numbers for tests/tools/metrics_test.cpp, from other people's implementations.

    python3 -m venv peers && peers/bin/pip install numpy==2.4.6 scikit-image==0.26.0 flip-evaluator==1.7
    peers/bin/python tests/peers/metrics_reference.py

The images are made by formula, the same one as in the test, so that nothing but numbers has to be kept.
"""
import numpy as np
from skimage.color import deltaE_ciede2000
from skimage.metrics import structural_similarity
import flip_evaluator

WIDTH, HEIGHT = 72, 56


def grid():
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    return x[:, :, None], y[:, :, None], np.arange(3.0)[None, None, :]


def waves():
    x, y, c = grid()
    reference = 0.5 + 0.28 * np.sin(0.31 * x + 0.17 * y + c) + 0.17 * np.cos(0.011 * x * y - 0.7 * c)
    test = 1.04 * reference + 0.05 * np.sin(0.9 * x - 0.4 * y + 2.0 * c)
    return np.clip(reference, 0, 1), np.clip(test, 0, 1)


def checkers():
    x, y, c = grid()
    def board(shift):
        even = (np.floor((x + shift) / 9) + np.floor(y / 7)) % 2
        return np.where(even > 0, 0.85 - 0.25 * c, 0.08 + 0.2 * c)
    return board(0), board(1)


def linear_from_srgb(v):
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def luminance(rgb):
    return rgb @ np.array([0.2126, 0.7152, 0.0722])


SSIM = dict(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0)

for name, (reference, test) in {"waves": waves(), "checkers": checkers()}.items():
    print(name)
    print("  mse             %.15g" % np.mean((reference - test) ** 2))
    print("  ssim luminance  %.15g" % structural_similarity(luminance(reference), luminance(test), **SSIM))
    print("  ssim channels   %.15g" % structural_similarity(reference, test, channel_axis=-1, **SSIM))
    # The images taken as sRGB-encoded, and as linear.
    for kind, encoded in (("srgb", True), ("linear", False)):
        flip_map, mean, _ = flip_evaluator.evaluate(reference.astype(np.float32), test.astype(np.float32), "LDR", encoded, False, True,
                                                    {"ppd": 0.7 * 3840 / 0.7 * np.pi / 180})
        flip_map = np.asarray(flip_map).reshape(HEIGHT, WIDTH, -1)[:, :, 0]
        print("  flip %-10s %.9g   at (10, 20) %.9g, at (0, 0) %.9g, at (71, 55) %.9g" %
              (kind, mean, flip_map[20, 10], flip_map[0, 0], flip_map[55, 71]))

# The colour pairs of Sharma, Wu, Dalal 2005 in the order of tests/tools/metrics_test.cpp.
PAIRS = [
    (50.0000, 2.6772, -79.7751, 50.0000, 0.0000, -82.7485), (50.0000, 3.1571, -77.2803, 50.0000, 0.0000, -82.7485),
    (50.0000, 2.8361, -74.0200, 50.0000, 0.0000, -82.7485), (50.0000, -1.3802, -84.2814, 50.0000, 0.0000, -82.7485),
    (50.0000, -1.1848, -84.8006, 50.0000, 0.0000, -82.7485), (50.0000, -0.9009, -85.5211, 50.0000, 0.0000, -82.7485),
    (50.0000, 0.0000, 0.0000, 50.0000, -1.0000, 2.0000), (50.0000, -1.0000, 2.0000, 50.0000, 0.0000, 0.0000),
    (50.0000, 2.4900, -0.0010, 50.0000, -2.4900, 0.0009), (50.0000, 2.4900, -0.0010, 50.0000, -2.4900, 0.0010),
    (50.0000, 2.4900, -0.0010, 50.0000, -2.4900, 0.0011), (50.0000, 2.4900, -0.0010, 50.0000, -2.4900, 0.0012),
    (50.0000, -0.0010, 2.4900, 50.0000, 0.0009, -2.4900), (50.0000, -0.0010, 2.4900, 50.0000, 0.0010, -2.4900),
    (50.0000, -0.0010, 2.4900, 50.0000, 0.0011, -2.4900), (50.0000, 2.5000, 0.0000, 50.0000, 0.0000, -2.5000),
    (50.0000, 2.5000, 0.0000, 73.0000, 25.0000, -18.0000), (50.0000, 2.5000, 0.0000, 61.0000, -5.0000, 29.0000),
    (50.0000, 2.5000, 0.0000, 56.0000, -27.0000, -3.0000), (50.0000, 2.5000, 0.0000, 58.0000, 24.0000, 15.0000),
    (50.0000, 2.5000, 0.0000, 50.0000, 3.1736, 0.5854), (50.0000, 2.5000, 0.0000, 50.0000, 3.2972, 0.0000),
    (50.0000, 2.5000, 0.0000, 50.0000, 1.8634, 0.5757), (50.0000, 2.5000, 0.0000, 50.0000, 3.2592, 0.3350),
    (60.2574, -34.0099, 36.2677, 60.4626, -34.1751, 39.4387), (63.0109, -31.0961, -5.8663, 62.8187, -29.7946, -4.0864),
    (61.2901, 3.7196, -5.3901, 61.4292, 2.2480, -4.9620), (35.0831, -44.1164, 3.7933, 35.0232, -40.0716, 1.5901),
    (22.7233, 20.0904, -46.6940, 23.0331, 14.9730, -42.5619), (36.4612, 47.8580, 18.3852, 36.2715, 50.5065, 21.2231),
    (90.8027, -2.0831, 1.4410, 91.1528, -1.6435, 0.0447), (90.9257, -0.5406, -0.9208, 88.6381, -0.8985, -0.7239),
    (6.7747, -0.2908, -2.4247, 5.8714, -0.0985, -2.2286), (2.0776, 0.0795, -1.1350, 0.9033, -0.0636, -0.5514)]
print("delta E 2000")
for p in PAIRS:
    print("  %.4f" % deltaE_ciede2000(np.array(p[:3]), np.array(p[3:])), end="")
print()
