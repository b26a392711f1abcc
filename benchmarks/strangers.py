"""Results for photos, meshes and recordings that were not used for tuning: one line each.

    python -m benchmarks strangers FOLDER -o DIR [--preset quick] [--longest 1800]

Finds the inputs below FOLDER by their kind: folders of at least three photos (without a mesh next to them, whose
textures they would be), photo folders of COLMAP models, videos and captures of phones; mesh files; run folders, and CSV
or npz files of poses with their scene next to them, `NAME.yaml` for one file or `scene.yaml` for all others. It runs
the commands that a user would run: `reconstruct` for photos and `simulate` for the scene; `fit` for a mesh (with --cap,
if it is refused as open), which is then scaled to 20 cm and dropped from half its size onto a floor, with `sdf: grid`
if the fit misses its certificate; `identify` for recordings. Commands run in separate processes, none for longer than
`--longest` seconds, so that one input cannot stop the others. Writes DIR/table.json, and a record for each kind that
was found, failures first. A second run with the same DIR continues: inputs that are in its table.json are not repeated.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.records import ROOT, Cell, Out, write_record
from pipeline.inputs.captures import ARCHIVES
from pipeline.inputs.sources import MIN_PHOTOS, VIDEOS, photos_in
from sdfsim import Scene, load_shape
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import visible, write_json
from sdfsim.evaluation.harness import number
from sdfsim.geometry.mesh_io import MESH_SUFFIXES

SIZE, SECONDS = 0.2, 5.0  # m, width of a dropped mesh; s, time limit for coming to rest
PROGRAM = "from cli import app; app()"
HEAD = ("input", "kind", "result", "s", "error", "at rest", "faults")


@dataclass(frozen=True)
class Found:
    """An input: its kind and its files. Recordings of one scene are one input."""

    kind: str  # photos, mesh or recordings
    files: tuple[Path, ...]
    scene: Path | None = None  # of recordings


@dataclass
class Row:
    """The result for an input."""

    name: str
    kind: str
    became: str = "nothing"
    seconds: float = 0.0  # wall-clock time of all commands
    exact: str = ""  # the certificate, the scale, or the errors of motions
    rests: str = ""
    wrong: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # only in table.json

    def cells(self) -> tuple[Cell, ...]:
        told = "; ".join(self.wrong).replace("|", "/").replace("\n", " ")
        return (f"`{self.name}`", self.kind, self.became, round(self.seconds), self.exact, self.rests, told)


class Failed(Exception):
    """A command that failed, with the reason in one line."""


# --- finding ---


def found_in(folder: Path) -> Iterator[Found]:
    """All inputs in a folder and below it, in name order."""
    inside = visible(folder)
    files = [path for path in inside if path.is_file()]
    if (folder / "rollout.npz").exists():
        yield Found("recordings", (folder,))
        return
    meshes = [path for path in files if path.suffix.lower() in MESH_SUFFIXES]
    if not meshes and len(photos_in(folder)) >= MIN_PHOTOS:
        yield Found("photos", (folder,))
        return
    yield from (Found("photos", (path,)) for path in files if path.suffix.lower() in VIDEOS | set(ARCHIVES))
    yield from (Found("mesh", (path,)) for path in meshes)
    poses = [path for path in files if path.suffix in (".csv", ".npz")]
    own = [path for path in poses if path.with_suffix(".yaml").exists()]
    yield from (Found("recordings", (path,), path.with_suffix(".yaml")) for path in own)
    if others := tuple(path for path in poses if path not in own):
        scene = folder / "scene.yaml"
        yield Found("recordings", others, scene if scene.exists() else None)
    for path in inside:
        if path.is_dir():
            yield from found_in(path)


# --- judging ---


def command(*arguments: object, longest: float) -> dict[str, Any]:
    """The report of a command of sdfsim. Raises Failed with its error message if it fails."""
    line = [sys.executable, "-c", PROGRAM, *map(str, arguments), "--json"]
    try:
        done = subprocess.run(
            line, cwd=ROOT, env=os.environ, capture_output=True, text=True, errors="replace", timeout=longest
        )
    except subprocess.TimeoutExpired as error:
        raise Failed(f"{arguments[0]}: stopped after {longest:.0f} s") from error
    try:
        report = json.loads(done.stdout)
    except ValueError as error:
        last = (done.stderr.strip() or "no word").splitlines()[-1]
        how = f"killed by signal {-done.returncode}" if done.returncode < 0 else f"ended with {done.returncode}"
        raise Failed(f"{arguments[0]}: {how}: {last}") from error
    if "error" in report and "exit_code" in report:
        hint = f" ({report['hint']})" if report.get("hint") else ""
        raise Failed(f"{arguments[0]}: {report['error']}{hint}")
    return report


def of_mesh(found: Found, row: Row, place: Path, run: Callable[..., dict[str, Any]]) -> None:
    """Fit a mesh, and drop it onto a floor."""
    (mesh,), shape = found.files, place / "shape"
    capped = ""
    try:
        fit = run("fit", mesh, "-o", shape)
    except Failed as error:
        if "--cap" not in str(error):
            raise
        fit, capped = run("fit", mesh, "-o", shape, "--cap"), "capped and "
    row.became = f"{capped}fitted"
    row.exact = f"{number(100 * fit['error_within_0.01'], 2)} % of its size"
    row.notes += fit["notes"]
    row.wrong += [*fit["failed_checks"], *([f"not exact: {fit['caveat']}"] if fit["caveat"] else [])]
    corners = load_shape(shape).mesh.vertices
    scale = SIZE / float(np.ptp(corners, axis=0).max())
    made: dict[str, Any] = {"asset": str(shape.resolve())}
    if not fit["passed"]:
        row.became = "grid"
        made = {"mesh": str(mesh.resolve()), "sdf": "grid", "cap": "on"}
    up = 0.5 * SIZE - scale * corners[:, 2].min()
    # A floor whose coefficients, with those of the falling body, give a friction of 0.4 and a restitution of 0.2.
    scene = Scene(duration=SECONDS).add("floor", plane={}, friction=0.8, restitution=0.4)
    scene.add("it", **made, scale=float(scale), position=(0.0, 0.0, float(up)))
    scene.save(place / "scene.yaml")
    dropped(place, row, run)


def of_photos(found: Found, row: Row, place: Path, run: Callable[..., dict[str, Any]], preset: str) -> None:
    """Reconstruct a scene, and let its bodies come to rest."""
    room = place / "room"
    try:
        report = run("reconstruct", found.files[0], "-o", room, "--preset", preset)
    except Failed as error:
        row.wrong.append(str(error))
        if not (room / "report.json").exists():
            return
        report = json.loads((room / "report.json").read_text(encoding="utf-8"))
    poses, stages = report["poses"], report["stages"]
    if poses:
        row.became = f"{poses['posed']} of {poses['photos']} posed"
    told = [*(["scale: " + stages["mesh"]["size"]] if "mesh" in stages else [])]
    if report["psnr"] is not None:
        told.append(f"PSNR {number(report['psnr'])} dB")
    row.exact = ", ".join(told)
    row.notes += report["notes"]
    row.wrong += [*report["failed_checks"], *poses.get("causes", []), *poses.get("warnings", [])]
    if (room / "scene.yaml").exists():
        dropped(place, row, run, room / "scene.yaml")


def dropped(place: Path, row: Row, run: Callable[..., dict[str, Any]], scene: Path | None = None) -> None:
    """Simulate a scene until all bodies rest."""
    report = run(
        "simulate", scene or place / "scene.yaml", "-o", place / "run", "--viewer", "none",
        "--until-settled", "--seconds", SECONDS, "--allow-outside",
    )  # fmt: skip
    bodies = report["ended"]
    row.rests = f"{sum(body['rests'] for body in bodies)} of {len(bodies)}, {report['simulated_s']:.2g} s"
    if not report["settled"]:
        row.wrong.append(f"not at rest after {SECONDS:g} s")
    row.wrong += [f"{body['name']} left the scene" for body in bodies if body["left"]]
    row.wrong += [f"breaks a law: {line}" for line in report["broken_laws"]]


def of_recordings(found: Found, row: Row, place: Path, run: Callable[..., dict[str, Any]]) -> None:
    """Identify the parameters of a scene."""
    report = run("identify", *found.files, *(["--scene", found.scene, "--allow-outside"] if found.scene else []))
    held = report["held_out"]
    after, before = ("{:.2g} % and {:.2g} degrees".format(*held[when]) for when in ("after", "before"))
    row.became = f"{report['windows']} windows repeated to {1e3 * report['error_m']:.2g} mm"
    row.exact = f"{after} off; {before} as the scene was"
    row.notes += report["notes"]
    if any(now > was for now, was in zip(held["after"], held["before"], strict=True)):
        row.wrong.append("the identified numbers are farther off than those of the scene")


def named(found: Found, folder: Path) -> str:
    """The name of an input in the table."""
    name = found.files[0].relative_to(folder).as_posix()
    return name if len(found.files) == 1 else f"{name} and {len(found.files) - 1} more"


def judged(found: Found, folder: Path, out: Out, preset: str, longest: float) -> Row:
    """The row of an input, including any failure."""
    row = Row(named(found, folder), found.kind)
    place = out / found.files[0].relative_to(folder)
    began = time.monotonic()
    try:
        place.mkdir(parents=True, exist_ok=True)

        def run(*arguments: object) -> dict[str, Any]:
            return command(*arguments, longest=longest)

        if found.kind == "mesh":
            of_mesh(found, row, place, run)
        elif found.kind == "photos":
            of_photos(found, row, place, run, preset)
        else:
            of_recordings(found, row, place, run)
    except Failed as error:
        row.wrong.append(str(error))
    except (SdfsimError, OSError, KeyError, ValueError) as error:
        row.wrong.append(f"{type(error).__name__}: {error}")
    row.seconds = time.monotonic() - began
    return row


# --- telling ---


def recorded(kind: str, rows: list[Row]) -> None:
    """Write the record of a kind: first inputs without a result, then those with faults, then the others."""
    ordered = sorted(rows, key=lambda row: (row.became != "nothing", not row.wrong, row.name))
    good = sum(not row.wrong and row.became != "nothing" for row in rows)
    command, measured = "python -m benchmarks strangers FOLDER -o DIR", f"Public {kind} that were not used for tuning."
    told = [f"{good} of {len(rows)} without a fault."]
    write_record(f"strangers_{kind}", command, measured, HEAD, [row.cells() for row in ordered], told)


def main(folder: Path, *, out: Out, preset: str = "quick", longest: float = 1800.0) -> None:
    """Print a line for each input, and write a record for each kind."""
    if not folder.is_dir():
        raise SdfsimError(f"{folder}: no such folder", "give the folder that holds photos, meshes or recordings")
    folder, out = folder.resolve(), out.resolve()  # commands run in another folder
    inputs = list(found_in(folder))
    if not inputs:
        raise SdfsimError(f"{folder}: no photos, meshes or recordings in it or below it")
    done = out / "table.json"
    rows = [Row(**row) for row in json.loads(done.read_text(encoding="utf-8"))] if done.exists() else []
    for found in inputs:
        if named(found, folder) in {row.name for row in rows}:
            continue
        rows.append(judged(found, folder, out, preset, longest))
        print(*filter(None, rows[-1].cells()), sep=" | ", flush=True)
        write_json(done, [asdict(row) for row in rows])  # the rows so far
    for kind in sorted({row.kind for row in rows}):
        recorded(kind, [row for row in rows if row.kind == kind])
