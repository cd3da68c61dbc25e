#!/usr/bin/env python3
"""Writes the LAZ and E57 files of this folder with other programs: laspy with lazrs, and pye57 (libE57Format). The points are made up
by the formulas below, which laz_test.cpp and e57_test.cpp repeat.   usage: python3 -m venv v && v/bin/pip install 'laspy[lazrs]' pye57 && v/bin/python make_files.py"""
import numpy as np
import laspy
import lazrs
from pye57 import libe57


def las_points(header, n):
    i = np.arange(n)
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = 1000 + 7 * i, -250 + i * i % 1001, i % 13
    las.intensity = 500 + i % 100
    las.return_number = 1 + i % 3
    las.number_of_returns = np.full(n, 3)
    las.classification = i % 7
    las.user_data = i % 11
    las.point_source_id = 77 + i % 2
    names = list(las.point_format.dimension_names)
    if "scan_angle" in names:
        las.scan_angle = -2000 + i % 50
    else:
        las.scan_angle_rank = -12 + i % 5
    if "gps_time" in names:
        las.gps_time = 1234.5 + 0.25 * i
    if "red" in names:
        las.red, las.green, las.blue = 60000 - i % 1000, 2 + i % 50, np.full(n, 300)
    if "nir" in names:
        las.nir = 4 * (i % 1000)
    if "wavepacket_index" in names:
        las.wavepacket_index = i % 2
        las.wavepacket_size = 5 + i % 3
        las.x_t = 0.5 * i
    if "amplitude" in names:
        las.amplitude = 0.125 * i
        las.pulse = i % 5
    return las


def make_header(point_format, version, extras=False):
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.01] * 3, [100.0, 0.0, -5.0]
    if extras:
        header.add_extra_dims([laspy.ExtraBytesParams("amplitude", np.float32), laspy.ExtraBytesParams("pulse", np.uint8)])
    return header


for f in range(11):
    version = "1.2" if f <= 3 else "1.3" if f <= 5 else "1.4"
    las_points(make_header(f, version, extras=f in (3, 7)), 9).write(f"format_{f}.laz", do_compress=True, laz_backend=laspy.LazBackend.Lazrs)

las = laspy.LasData(make_header(0, "1.2"))  # three chunks, small since nearly nothing changes
las.X, las.Y, las.Z = 7 * np.arange(120_000), np.full(120_000, 5), np.arange(120_000) // 40_000
las.write("three_chunks.laz", do_compress=True, laz_backend=laspy.LazBackend.Lazrs)

# Chunks of unequal size, as COPC has them: the header of laspy, the points through lazrs.
las = las_points(make_header(7, "1.4"), 30)
las.write("variable_chunks.laz", do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
whole = open("variable_chunks.laz", "rb").read()
start = int.from_bytes(whole[96:100], "little")
fixed = lazrs.LazVlr.new_for_compression(7, 0, False).record_data()
variable = lazrs.LazVlr.new_for_compression(7, 0, True)
with open("variable_chunks.laz", "wb+") as out:
    out.write(whole[:start].replace(bytes(fixed), bytes(variable.record_data())))
    packer = lazrs.LasZipCompressor(out, variable)
    rows = np.frombuffer(las.points.array.tobytes(), np.uint8)
    size = len(rows) // 30
    for begin, end in ((0, 1), (1, 18), (18, 30)):
        packer.compress_many(rows[begin * size:end * size])
        packer.finish_current_chunk()
    packer.done()


def number(image, value):
    return libe57.FloatNode(image, float(value))


def structure(image, **children):
    node = libe57.StructureNode(image)
    for name, child in children.items():
        node.set(name, child)
    return node


def add_scan(image, scans, columns, rotation, translation, limits=None):
    """columns: name -> (node of the prototype, values)"""
    scan = structure(image, guid=libe57.StringNode(image, f"{{scan {scans.childCount()}}}"))
    scan.set("pose", structure(image, rotation=structure(image, **{k: number(image, v) for k, v in zip("wxyz", rotation)}),
                               translation=structure(image, **{k: number(image, v) for k, v in zip("xyz", translation)})))
    if limits:
        scan.set("colorLimits", structure(image, **{name: libe57.IntegerNode(image, value) for name, value in limits.items()}))
    prototype = libe57.StructureNode(image)
    buffers, arrays = libe57.VectorSourceDestBuffer(), []
    for name, (node, values) in columns.items():
        prototype.set(name, node)
        arrays.append(values)
        buffers.append(libe57.SourceDestBuffer(image, name, values, len(values), True, True))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("points", points)
    scans.append(scan)
    writer = points.writer(buffers)
    writer.write(len(arrays[0]))
    writer.close()


def start_e57(name):
    image = libe57.ImageFile(name, "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    image.extensionsAdd("nor", "http://www.libe57.org/E57_EXT_surface_normals.txt")
    root = image.root()
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(image, "{made for tests}"))
    root.set("versionMajor", libe57.IntegerNode(image, 1))
    root.set("versionMinor", libe57.IntegerNode(image, 0))
    scans = libe57.VectorNode(image, True)
    root.set("data3D", scans)
    return image, scans


def whole(image, low, high):
    return libe57.IntegerNode(image, low, low, high)


def two_scans():
    image, scans = start_e57("two_scans.e57")
    n = 40
    i = np.arange(n)
    metres = lambda: libe57.ScaledIntegerNode(image, 0, -(2**18), 2**18 - 1, 0.001, 10.0)
    add_scan(image, scans, {
        "cartesianX": (metres(), 10.0 + 0.125 * i),
        "cartesianY": (metres(), 10.0 - 0.250 * i),
        "cartesianZ": (metres(), 12.0 + 0.001 * i * i),
        "cartesianInvalidState": (whole(image, 0, 2), (i % 8 == 3).astype(np.int8) * 2),
        "rowIndex": (whole(image, 0, 4), (i % 5).astype(np.int16)),
        "columnIndex": (whole(image, 0, 7), (i // 5).astype(np.int16)),
        "intensity": (whole(image, 0, 60000), (i * 1500).astype(np.uint16)),
        "colorRed": (whole(image, 0, 255), (i * 6).astype(np.uint8)),
        "colorGreen": (whole(image, 0, 255), (255 - i).astype(np.uint8)),
        "colorBlue": (whole(image, 0, 255), np.full(n, 9, np.uint8)),
        "returnIndex": (whole(image, 0, 3), (i % 2).astype(np.int8)),
        "returnCount": (whole(image, 0, 3), np.full(n, 2, np.int8)),
        "timeStamp": (libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, 0.0, 1e6), 0.5 * i),
    }, (np.sqrt(0.5), 0, 0, np.sqrt(0.5)), (100.0, 200.0, -3.0))  # a quarter turn about z
    n = 12
    i = np.arange(n)
    angle = lambda: libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -4.0, 4.0)
    add_scan(image, scans, {
        "sphericalRange": (libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, 0.0, 100.0), (1.0 + 0.5 * i)),
        "sphericalAzimuth": (angle(), 0.25 * i),
        "sphericalElevation": (angle(), 0.125 * i - 0.5),
        "sphericalInvalidState": (whole(image, 0, 2), (i == 5).astype(np.int8)),
        "intensity": (whole(image, 0, 60000), (i + 1).astype(np.uint16)),
        "nor:normalX": (libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -1.0, 1.0), np.full(n, 0.6)),
        "nor:normalY": (libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -1.0, 1.0), np.full(n, 0.0)),
        "nor:normalZ": (libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -1.0, 1.0), np.full(n, 0.8)),
    }, (1, 0, 0, 0), (0.0, 0.0, 1000.0))
    image.close()


def one_point():
    image, scans = start_e57("one_point.e57")
    single = lambda: libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -10.0, 10.0)
    levels = lambda: libe57.IntegerNode(image, 0, 0, 1023)
    add_scan(image, scans, {
        "cartesianX": (single(), np.array([1.5])),
        "cartesianY": (single(), np.array([-2.5])),
        "cartesianZ": (single(), np.array([0.25])),
        "intensity": (libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, 0.0, 1.0), np.array([0.75], np.float32)),
        "colorRed": (levels(), np.array([1023], np.uint16)),
        "colorGreen": (levels(), np.array([0], np.uint16)),
        "colorBlue": (levels(), np.array([512], np.uint16)),
    }, (1, 0, 0, 0), (0, 0, 0), dict(colorRedMinimum=0, colorRedMaximum=1023, colorGreenMinimum=0, colorGreenMaximum=1023, colorBlueMinimum=0, colorBlueMaximum=1023))
    image.close()


two_scans()
one_point()
