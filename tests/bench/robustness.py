#!/usr/bin/env python3
"""Robustness curves: what one thing gone wrong does to the albedo, and whether sigma and the run's notes say so.

    python tests/bench/robustness.py SCENE … [--out DIR] [--only NAME …] [--picture FILE.png] [--redraw] [--chiaro EXE] [--set KEY=VALUE …]

SCENE is a rendered scene with truth/ (docs/peers.md). Each disturbance (tests/bench/disturbances.py) is done to a copy of the scene by each of its levels, and the copy run by
the joint method. Needs numpy, scipy, OpenEXR and, for the picture, matplotlib from PyPI. Rows are kept in OUT/rows.json: --redraw prints and draws them without running anything.
"""
import argparse
import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "peers"))
import chiaro_runs  # noqa: E402
import disturbances  # noqa: E402
import scene_copy  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
MEAN_OF_NORMAL = np.sqrt(2 / np.pi)   # mean absolute deviation, in standard deviations
HEADER = """| scene | disturbance | level | albedo error, mean / median, % | after one factor, % | ln Lp error (sd), % | sigma expects, mean, % | z of sigma: rms, within 2 | exit | the run says |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | --- |"""


def said_by(out):
    """Notes of a run, and what it left out."""
    record = json.loads((out / "run.json").read_text())
    return record["notes"] + ["%s left out: %s" % (l["name"], l["reason"]) for l in record["left_out"]]


def measure(options, scene, name, level, base):
    """One run of a disturbed copy, started from the undisturbed run's folder so that what the disturbance does not touch is not done again."""
    folder, out = options.out / ("%s.%s.%.3g.scene" % (scene.name, name, level)), options.out / ("%s.%s.%.3g" % (scene.name, name, level))
    scene_copy.link_scene(scene, folder)
    shutil.rmtree(out, ignore_errors=True)
    if base:
        disturbances.ALL[name][0](scene, folder, level)
        shutil.copytree(base, out)
    extra = [word for pair in options.set for word in ("--set", pair)]
    outcome = chiaro_runs.run(options.chiaro, folder / "project.toml", out, "joint", options.out / "log.txt", extra, truth=scene / "truth")
    row = {"scene": scene.name, "disturbance": name, "level": level, "notes": said_by(out) if (out / "run.json").exists() else [], **asdict(outcome)}
    if base:
        shutil.rmtree(out)
    shutil.rmtree(folder)
    return row


def text_of(row, undisturbed):
    new = [n for n in row["notes"] if not undisturbed or n not in undisturbed["notes"]]
    cells = [row["scene"], row["disturbance"].replace("_", " "), "%.3g" % row["level"]]
    if row["note"]:
        return "| %s | %s | | | | | | |" % (" | ".join(cells), row["note"])
    light = row["lights"][0]
    cells += ["%.2f / %.2f" % tuple(row["error"]), "%.2f / %.2f" % tuple(row["scaled"]), "%+.1f (%.1f)" % (100 * light[0], 100 * light[1]), "%.2f" % (100 * MEAN_OF_NORMAL * row["sigma"]),
              "%.2f, %.0f %%" % (row["z_rms"], 100 * row["within_two"]), str(row["code"]), "; ".join(new)]
    return "| %s |" % " | ".join(cells)


def draw(rows, file):
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    names = [n for n in disturbances.ALL if any(r["disturbance"] == n for r in rows)]
    scenes = sorted({r["scene"] for r in rows})
    across = min(4, len(names))
    down = -(-len(names) // across)
    figure, axes = plt.subplots(down, across, figsize=(3.1 * across + 0.3, 2.6 * down), squeeze=False)
    for axis, name in zip(axes.flat, names):
        plain = disturbances.ALL[name][3]
        for k, scene in enumerate(scenes):
            mine = [r for r in rows if r["scene"] == scene and not r["note"] and (r["disturbance"] == name or r["disturbance"] == "none")]
            curve = sorted((plain if r["disturbance"] == "none" else r["level"], r["error"][0], 100 * MEAN_OF_NORMAL * r["sigma"]) for r in mine)
            if len(curve) < 2:
                continue
            level, error, expected = zip(*curve)
            axis.plot(level, error, "o-", color="C%d" % k, markersize=3, label=scene)
            axis.plot(level, expected, "--", color="C%d" % k)
        axis.set_title(name.replace("_", " "), fontsize=9)
        axis.set_xlabel(disturbances.ALL[name][1], fontsize=7)
        axis.set_ylim(bottom=0)
        axis.tick_params(labelsize=7)
    for axis in list(axes.flat)[len(names):]:
        axis.axis("off")
    axes[0][0].legend(fontsize=7)
    figure.supylabel("mean error of albedo, %: made (line), expected by sigma (dashed)", fontsize=8, x=0.005)
    figure.tight_layout(rect=(0.02, 0, 1, 1))
    figure.savefig(file, dpi=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--out", type=Path, default=Path("robustness.out"))
    parser.add_argument("--only", nargs="+", default=list(disturbances.ALL), choices=list(disturbances.ALL))
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--redraw", action="store_true")
    parser.add_argument("--chiaro", type=Path, default=ROOT / "build/release/chiaro")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="handed on to chiaro run")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    kept = options.out / "rows.json"
    rows = json.loads(kept.read_text()) if kept.exists() else []
    print(HEADER, flush=True)

    def add(row):
        rows[:] = [r for r in rows if (r["scene"], r["disturbance"], r["level"]) != (row["scene"], row["disturbance"], row["level"])] + [row]
        kept.write_text(json.dumps(rows, indent=1))
        show(row)

    def show(row):
        print(text_of(row, next((r for r in rows if r["scene"] == row["scene"] and r["disturbance"] == "none" and r is not row), None)), flush=True)

    if options.redraw:
        for row in rows:
            show(row)
    for scene in [] if options.redraw else [s.resolve() for s in options.scenes]:
        add(measure(options, scene, "none", 0, None))
        base = options.out / ("%s.none.0" % scene.name)
        for name in options.only:
            if not disturbances.is_possible(name, scene):
                print("%s: left out for %s, whose truth lacks the shares of light in some photographs" % (name, scene.name), file=sys.stderr)
                continue
            for level in disturbances.ALL[name][2]:
                add(measure(options, scene, name, level, base))
        shutil.rmtree(base)
    if options.picture:
        draw(rows, options.picture)


if __name__ == "__main__":
    main()
