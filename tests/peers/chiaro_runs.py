"""Runs chiaro on a scene with known answers and says how far off it is: albedo, lights, and whether sigma tells the truth."""
import json
import os
import re
import subprocess
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np


@dataclass
class Outcome:
    points: int = 0
    error: tuple = (np.nan, np.nan)             # |albedo - truth| / truth, mean over channels: mean and median over points, per cent
    scaled: tuple = (np.nan, np.nan)            # the same after the common factor that fits best
    lights: list = field(default_factory=list)  # (ln Lp error, its sd, ln La error, its sd) per acquisition or per photograph
    photographs: list = field(default_factory=list)   # name of each row of `lights`; empty where all share theirs
    references: int = 0                         # targets of known albedo that the project names
    targets: list = field(default_factory=list)   # photographs that show them
    z_rms: float = np.nan                       # of ln(albedo / truth) over sigma
    z_robust: float = np.nan                    # 1.48 median |z|
    within_two: float = np.nan                  # share of |z| < 2
    sigma: float = np.nan                       # mean over points
    code: int = 0                               # of the run's exit
    z_own: float = np.nan                       # 1.48 median of |ln error - its median| over sigma without the flash's sd, which all points share
    core_seconds: float = np.nan
    peak_mib: float = np.nan
    note: str = ""


def timed(command, log):
    """(exit code, core-seconds, peak MiB) of a command; its output goes to the file `log`."""
    with open(log, "ab") as f:
        f.write((" ".join(command) + "\n").encode())
        f.flush()
        process = subprocess.Popen(command, stdout=f, stderr=f)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def read_ply(path):
    """Vertices of a binary little-endian PLY with scalar properties, as a structured array."""
    raw = Path(path).read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    header = raw[:end].decode("ascii", "replace")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2", "int": "<i4", "uint": "<u4"}
    fields = [(name, kinds[kind]) for kind, name in re.findall(r"^property (\w+) (\w+)\s*$", header, re.M)]
    return np.frombuffer(raw, np.dtype(fields), int(re.search(r"element vertex (\d+)", header).group(1)), end)


def albedo_errors(albedo, truth):
    """((mean, median), (mean, median) after one factor), per cent; rows that are not finite or black in truth are left out."""
    good = np.isfinite(albedo).all(axis=1) & (truth > 0).all(axis=1)
    a, t = albedo[good], truth[good]
    def both(x):
        e = 100 * np.mean(np.abs(x - t) / t, axis=1)
        return float(np.mean(e)), float(np.median(e))
    return both(a), both(a * (np.sum(a * t) / np.sum(a * a)))


def with_target(project):
    """Names of the photographs that show something of known albedo."""
    return {r["photograph"] for a in tomllib.loads(Path(project).read_text())["acquisition"] for r in a.get("reference", [])}


def light_errors(record, truth):
    """Rows of (ln Lp error, sd, ln La error, sd)."""
    rows = []
    for acquisition in record["acquisitions"]:
        for found in acquisition.get("photographs", [acquisition]):
            flash, ambient = found["flash_intensity"], found["ambient"]
            rows.append((np.log(flash / truth["flash_intensity_w_per_sr"]), found["flash_intensity_sd"] / flash,
                         np.log(ambient / truth["ambient_radiance"]) if ambient > 0 else -np.inf, found["ambient_sd"] / ambient if ambient > 0 else np.nan))
    return rows


def run(chiaro, project, out, method, log, options=(), truth=None):
    """Runs `method` into the folder `out`. truth: folder of what is known, default truth/ beside the project."""
    code, core, peak = timed([str(chiaro), "run", str(project), "--out", str(out), "--quiet", "--set", "solve.method=" + method, *options], log)
    result = Outcome(core_seconds=core, peak_mib=peak, code=code)
    if code not in (0, 3):
        result.note = "exit %d" % code
        return result
    known = Path(truth or Path(project).parent / "truth")
    points = read_ply(Path(out) / "albedo.ply")
    truth = np.load(known / "albedo.npy").astype(np.float64)
    albedo = np.stack([points["albedo_" + c] for c in "rgb"], 1).astype(np.float64)
    seen = np.isfinite(albedo).all(axis=1)
    result.points = int(seen.sum())
    result.error, result.scaled = albedo_errors(albedo, truth)
    found = json.loads((Path(out) / "lights.json").read_text())
    result.lights = light_errors(found, json.loads((known / "lights.json").read_text()))
    result.photographs = [p["photograph"] for a in found["acquisitions"] for p in a.get("photographs", [])]
    result.references = sum(a.get("references", 0) for a in found["acquisitions"])
    result.targets = sorted(with_target(project))
    sigma = points["sigma"][seen].astype(np.float64)
    result.sigma = float(np.mean(sigma))
    off = np.log(np.maximum(albedo[seen].mean(1), 1e-4) / truth[seen].mean(1))
    own = np.sqrt(np.maximum(sigma ** 2 - np.median([r[1] for r in result.lights]) ** 2, 1e-6))
    result.z_own = float(1.4826 * np.median(np.abs(off - np.median(off)) / own))
    z = off / sigma
    z = z[np.isfinite(z)]
    result.z_rms, result.z_robust, result.within_two = float(np.sqrt(np.mean(z ** 2))), float(1.4826 * np.median(np.abs(z))), float(np.mean(np.abs(z) < 2))
    return result


def light_text(rows, column):
    """'error (sd) %' of a light; over several photographs the rms of the error and the median sd."""
    errors, sds = np.array([r[column] for r in rows]), np.array([r[column + 1] for r in rows])
    if not np.isfinite(errors).all():
        return "none" if not np.isfinite(errors).any() else "none in %d of %d" % (np.sum(~np.isfinite(errors)), len(errors))
    if len(rows) == 1:
        return "%+.1f (%.1f)" % (100 * errors[0], 100 * sds[0])
    return "rms %.1f (%.1f)" % (100 * np.sqrt(np.mean(errors ** 2)), 100 * np.median(sds))


HEADER = """| project | method | points | albedo error, mean / median, % | after one factor, % | ln Lp error (sd), % | ln La error (sd), % | z of sigma: rms, robust, within 2; own part | core-s | peak MiB |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"""


def row(name, method, r):
    if r.note:
        return "| %s | %s | %s | | | | | | %.0f | %.0f |" % (name, method, r.note, r.core_seconds, r.peak_mib)
    sigma = "–" if method in ("direct", "adam") else "%.2f, %.2f, %.0f %%; %.2f" % (r.z_rms, r.z_robust, 100 * r.within_two, r.z_own)
    lights = ("–", "–") if method == "direct" else (light_text(r.lights, 0), light_text(r.lights, 2))
    return "| %s | %s | %d | %.2f / %.2f | %.2f / %.2f | %s | %s | %s | %.0f | %.0f |" % (name, method, r.points, *r.error, *r.scaled, *lights, sigma, r.core_seconds, r.peak_mib)


LIGHTS_HEADER = """| project | method | ln Lp error (sd), % | within 2 sd | sd of ln Lp: most allowed, % | ln La error (sd), % | within 2 sd | ln (La / Lp) error, % (3 wanted) | missed |
| --- | --- | ---: | --- | ---: | ---: | --- | ---: | --- |"""
MOST_SD, MOST_SD_REFERENCE, MOST_RATIO = 0.06, 0.015, 0.03


def lights_rows(name, method, r):
    """lights_row(), and one more of the photographs that show a target by themselves where each has its own lights."""
    with_own = [row for photograph, row in zip(r.photographs, r.lights) if photograph in r.targets]
    own = [lights_row("%s, %s alone" % (name, ", ".join(r.targets)), method, replace(r, lights=with_own))] if with_own and len(with_own) < len(r.lights) else []
    return [lights_row(name, method, r)] + own


def lights_row(name, method, r):
    """What is asked of the lights themselves: errors that their sd covers, an sd that is small enough, and the ratio of ambient light to flash. Where no ambient light was found, nothing is asked of it."""
    if r.note:
        return "| %s | %s | %s | | | | | | |" % (name, method, r.note)
    rows = np.array(r.lights, dtype=float)
    most = MOST_SD_REFERENCE if r.references else MOST_SD
    sd = rows[:, 1].min() if r.references else np.median(rows[:, 1])   # where each photograph has its own: of the best, which shows the target
    ratio = rows[:, 2] - rows[:, 0]
    lit = np.isfinite(ratio)
    inside = [int(np.sum((np.abs(rows[:, c]) <= 2 * rows[:, c + 1]) | ~np.isfinite(rows[:, c]))) for c in (0, 2)]
    count = lambda n: ("yes" if n else "**no**") if len(rows) == 1 else "%d of %d" % (n, len(rows))
    missed = ["%s beyond 2 sd" % what for n, what in zip(inside, ("Lp", "La")) if n < len(rows)]
    missed += ["sd of Lp"] * int(sd > most) + ["ratio"] * int(lit.any() and np.sqrt(np.mean(ratio[lit] ** 2)) > MOST_RATIO)
    ratio_text = "–" if not lit.any() else "%+.1f" % (100 * ratio[0]) if len(rows) == 1 else "rms %.1f" % (100 * np.sqrt(np.mean(ratio[lit] ** 2)))
    return "| %s | %s | %s | %s | %.1f | %s | %s | %s | %s |" % (name, method, light_text(r.lights, 0), count(inside[0]), 100 * most, light_text(r.lights, 2), count(inside[1]), ratio_text, ", ".join(missed) or "–")
