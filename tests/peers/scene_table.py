#!/usr/bin/env python3
"""The table of figures on scenes with known answers: every method from scratch, albedo and lights against the truth, sigma against the errors made.

    python tests/peers/scene_table.py SCENE … [--methods joint single direct adam] [--projects 'project*.toml'] [--out DIR] [--chiaro EXE] [--set KEY=VALUE …] [--lights]

SCENE is a folder with project.toml and truth/ (docs/peers.md); needs numpy. Results stay in --out (default figures.out), each run in a folder of its own. --lights: a second table
afterwards, of the lights alone: whether their sd covers their error, whether it is small enough, and the ratio of ambient light to flash (methods joint and single).
"""
import argparse
import shutil
from pathlib import Path

import chiaro_runs

ROOT = Path(__file__).resolve().parents[2]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--methods", nargs="+", default=["joint", "single", "direct", "adam"])
    parser.add_argument("--projects", default="project.toml", help="pattern of project files in each scene")
    parser.add_argument("--out", type=Path, default=Path("figures.out"))
    parser.add_argument("--chiaro", type=Path, default=ROOT / "build/release/chiaro")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="handed on to chiaro run")
    parser.add_argument("--lights", action="store_true", help="a table of the lights too")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print(chiaro_runs.HEADER, flush=True)
    lights = []
    for scene in options.scenes:
        for project in sorted(scene.glob(options.projects)):
            for method in options.methods:
                out = options.out / ("%s.%s.%s" % (scene.resolve().name, project.stem, method))
                shutil.rmtree(out, ignore_errors=True)
                extra = [word for pair in options.set for word in ("--set", pair)]
                outcome = chiaro_runs.run(options.chiaro, project, out, method, options.out / "log.txt", extra)
                name = "%s/%s" % (scene.resolve().name, project.stem)
                print(chiaro_runs.row(name, method, outcome), flush=True)
                if method in ("joint", "single"):
                    lights += chiaro_runs.lights_rows(name, method, outcome)
    if options.lights:
        print("\n" + "\n".join([chiaro_runs.LIGHTS_HEADER] + lights))


if __name__ == "__main__":
    main()
