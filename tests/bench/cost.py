#!/usr/bin/env python3
"""What a photograph costs: rays, core-seconds and memory, of projects given and of synthetic ones with many photographs.

    python tests/bench/cost.py [PROJECT.toml …] [--synthetic K …] [--points N] [--size WxH] [--spec SPEC] [--memory SIZE] [--out DIR] [--chiaro EXE] [--keep]

Each project is run from scratch by the joint method, its processor time and largest resident set measured from outside. --synthetic makes a project with K photographs by
`chiaro synth --project` for each K (its cost is not counted). Prints a row each: rays of a photograph (from pixels, to the flash), gathered once for the project, core-seconds in all
and a photograph, share of stages by the clock, largest resident set, and the errors of the lights where truth/lights.json is there.
"""
import argparse
import json
import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "peers"))
import chiaro_runs  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
RAYS_PER_SURFEL = 64
HEADER = """| project | points | photographs | rays a photograph: primary, shadow | gathered, all | core-s, all | core-s a photograph | clock: ingest, raycast, gather, light, albedo, blend, % | peak MiB | ln Lp error (sd), % | ln La error (sd), % |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"""


def millions(v):
    return "%.2f M" % (v / 1e6)


def measure(options, project, out):
    """A row of the table."""
    shutil.rmtree(out, ignore_errors=True)
    command = [str(options.chiaro), "run", str(project), "--out", str(out), "--quiet", "--memory", options.memory]
    code, core, peak = chiaro_runs.timed(command, options.out / "log.txt")
    name = project.parent.name
    if code not in (0, 3):
        return "| %s | | | exit %d | | %.0f | | | %.0f | | |" % (name, code, core, peak)
    record, lights = json.loads((out / "run.json").read_text()), json.loads((out / "lights.json").read_text())
    counts, k = record["counts"], record["counts"]["photographs_used"]
    clock = lambda *stages: sum(s["seconds"] for s in record["stages"] if s["name"].split("/")[0] in stages)
    shares = [100 * clock(*s) / record["seconds"] for s in (("ingest",), ("raycast",), ("gather",), ("light",), ("albedo",), ("blend",))]
    known = project.parent / "truth/lights.json"
    errors = ["–", "–"]
    if known.exists():
        truth = json.loads(known.read_text())
        if "flash_intensity_w_per_sr" in truth and truth.get("ambient_radiance"):
            rows = chiaro_runs.light_errors(lights, truth)
            errors = [chiaro_runs.light_text(rows, c) for c in (0, 2)]
    gathered = sum(a.get("proxy_surfels", 0) for a in lights["acquisitions"]) * RAYS_PER_SURFEL
    return "| %s | %d | %d | %s, %s | %s | %.0f | %.2f | %s | %.0f | %s | %s |" % (name, counts["points_in"], k, millions(counts["rays_primary"] / k), millions(counts["rays_shadow"] / k), millions(gathered),
                                                                           core, core / k, ", ".join("%.0f" % s for s in shares), peak, *errors)


def make(options, photographs):
    folder = options.out / ("synthetic_%d" % photographs)
    shutil.rmtree(folder, ignore_errors=True)
    code, _, _ = chiaro_runs.timed([str(options.chiaro), "synth", options.spec, "--points", str(options.points), "--project", str(folder), "--photographs", str(photographs), "--size", options.size,
                                    "--quiet"], options.out / "log.txt")
    if code != 0:
        sys.exit("chiaro synth: exit %d, see %s" % (code, options.out / "log.txt"))
    return folder / "project.toml"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("projects", nargs="*", type=Path)
    parser.add_argument("--synthetic", nargs="+", type=int, default=[], metavar="K")
    parser.add_argument("--points", type=int, default=1000000)
    parser.add_argument("--size", default="64x48")
    parser.add_argument("--spec", default="statue:noise=0.0003")
    parser.add_argument("--memory", default="2GiB")
    parser.add_argument("--out", type=Path, default=Path("cost.out"))
    parser.add_argument("--chiaro", type=Path, default=ROOT / "build/release/chiaro")
    parser.add_argument("--keep", action="store_true", help="leave synthetic projects and results")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print(HEADER, flush=True)
    for project in [p.resolve() for p in options.projects]:
        out = options.out / (project.parent.name + "." + project.stem)
        print(measure(options, project, out), flush=True)
        if not options.keep:
            shutil.rmtree(out)
    for k in options.synthetic:
        project = make(options, k)
        print(measure(options, project, project.parent / "out"), flush=True)
        if not options.keep:
            shutil.rmtree(project.parent)


if __name__ == "__main__":
    main()
