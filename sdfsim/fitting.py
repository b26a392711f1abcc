"""What the fit command does: mesh files become shape folders, one or many."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from sdfsim.console import columns, duration
from sdfsim.dynamics.bodies import largest_extent
from sdfsim.dynamics.simulator import pick_device
from sdfsim.errors import SdfsimError
from sdfsim.files import check_writable, locked, read_json
from sdfsim.parallel import Progress, parallel, silent
from sdfsim.scene.scene_file import UNITS
from sdfsim.shape.baked_grid import grid_certificate
from sdfsim.shape.fit import FIT_VERSION, Recipe, fit_mesh
from sdfsim.shape.mesh import MESH_SUFFIXES, Mesh, load_mesh
from sdfsim.shape.shape import RECORD_FILE, Shape, load_shape

# m, sizes that need no word.
USUAL = (1e-3, 100.0)
ERRORS = ("error_within_0.01", "error_within_0.1", "error_in_box", "projected_from_0.01", "sign_errors")


@dataclass(frozen=True)
class Options:
    """How meshes are fitted; see `fit_mesh`. `units` are those of the mesh files, as in scene.yaml."""

    recipe: Recipe = "default"
    budget: float | None = None
    cap: bool = False
    thicken: float | None = None
    units: Literal["m", "cm", "mm", "in"] = "m"


def fit(mesh_file: Path, out: Path, options: Options, *, device: str, on_progress: Progress) -> dict[str, Any]:
    """Fit a mesh file and write the shape folder `out`; the report has the folder, volume, number of nodes, what was
    done to the mesh, the certificate, and in `failed_checks` whether it was missed. Raises SdfsimError where the mesh
    cannot be used, the folder cannot be written, or another run is writing to it."""
    mesh = _load(mesh_file, options)
    check_writable(out)
    with locked(out):
        shape = fit_mesh(
            mesh,
            name=out.resolve().name,
            recipe=options.recipe,
            budget=options.budget,
            cap=options.cap,
            thicken=options.thicken,
            on_progress=on_progress,
            device=pick_device(device),
        )
        certificate = shape.certificate | grid_certificate(shape.sdf, shape.nodes)
        source = shape.source | {"request": _request(mesh, options)}
        shape = replace(shape, source=source, certificate=certificate)
        shape.save(out)
    missed = [] if shape.certificate["passed"] else [f"fit: {shape.certificate['reason']}"]
    return _report(shape, out) | {"failed_checks": missed}


def fit_lines(report: dict[str, Any]) -> list[str]:
    """What a person reads of a `fit` report."""
    errors = ", ".join(f"{key.replace('_', ' ')} {report[key]:.2g}" for key in ERRORS if report.get(key) is not None)
    return [
        *report["notes"],
        f"errors relative to the size: {errors}",
        f"{report['nodes']} nodes, volume {report['volume_m3']:.4g} m^3, {duration(report['seconds'])}",
        f"wrote {report['folder']}",
    ]


def named_meshes(sources: list[Path]) -> dict[str, Path]:
    """Mesh files, and those of folders, by the names their shapes get: the file's own name without suffix; where
    several files share it, the name of the folder they lie in. Raises SdfsimError for no meshes, or two of one name."""
    files: list[Path] = []
    for source in sources:
        if source.is_dir():
            inside = sorted(p for p in source.iterdir() if p.suffix.lower() in MESH_SUFFIXES)
            if not inside:
                raise SdfsimError(f"{source}: no mesh files in this folder", "it takes " + " ".join(MESH_SUFFIXES))
            files += inside
        else:
            files.append(source)
    files = list(dict.fromkeys(files))
    stems = [file.stem for file in files]
    named: dict[str, Path] = {}
    for file in files:
        name = file.stem if stems.count(file.stem) == 1 else file.resolve().parent.name
        if name in named:
            raise SdfsimError(f"{named[name]} and {file} would both become {name}", "fit them into different folders")
        named[name] = file
    return named


def fit_many(
    meshes: dict[str, Path], out: Path, options: Options, *, device: str, on_progress: Progress
) -> dict[str, Any]:
    """Fit many mesh files into the shape folders `out`/NAME: in processes on CPUs, one after the other on a GPU.

    What an earlier call has fitted in the same way is kept. Returns `shapes`, by name the report of `fit` or the
    `error` that kept a mesh from being fitted; and in `failed_checks` what missed its certificate.
    """
    where = pick_device(device)
    check_writable(out)
    reports: dict[str, dict[str, Any]] = {}
    for name, file in meshes.items():
        if (kept := _kept(file, out / name, options)) is not None:
            reports[name] = kept
    todo = [(name, file) for name, file in meshes.items() if name not in reports]
    on_progress(0.0, f"{len(todo)} meshes to fit" + (f", {len(reports)} fitted before" if reports else ""))
    jobs = [(file, out / name, options, str(where)) for name, file in todo]
    made = enumerate(_fit_one(*job) for job in jobs) if where.type == "cuda" else parallel(_fit_one, jobs)
    for done, (index, report) in enumerate(made, start=1):
        name = todo[index][0]
        reports[name] = report
        on_progress(done / len(todo), f"{name}: {_verdict(report)}, {done} of {len(todo)}")
    missed = [f"{name}: {reports[name]['reason']}" for name in meshes if reports[name].get("passed") is False]
    return {"folder": str(out), "shapes": {name: reports[name] for name in meshes}, "failed_checks": missed}


def batch_lines(report: dict[str, Any]) -> list[str]:
    """`fit_many`'s report for people: a row a mesh."""
    heads = ("within 0.01", "within 0.1", "in box", "projected", "signs")
    rows: list[tuple[str, ...]] = [("", "", "seconds", "steps", *heads)]
    for name, found in report["shapes"].items():
        if "error" in found:
            rows.append((name, "failed", *[""] * (len(heads) + 2)))
        else:
            errors = ("-" if found.get(key) is None else f"{found[key]:.2g}" for key in ERRORS)
            rows.append((name, _verdict(found), f"{found['seconds']:.1f}", str(found["steps"]), *errors))
    problems = [f"{name}: {found['error']}" for name, found in report["shapes"].items() if "error" in found]
    notes = [f"{name}: {note}" for name, found in report["shapes"].items() for note in found.get("notes", [])]
    return [*columns(rows), *problems, *notes, f"wrote {report['folder']}"]


def _verdict(report: dict[str, Any]) -> str:
    if "error" in report:
        return "failed"
    return "fitted" if report["passed"] else "missed"


def _fit_one(file: Path, folder: Path, options: Options, device: str) -> dict[str, Any]:
    """A report, or the error; whatever happens to one mesh must not stop the others."""
    try:
        return fit(file, folder, options, device=device, on_progress=silent)
    except SdfsimError as error:
        return {"error": error.message, "hint": error.hint}
    except Exception as error:
        return {"error": f"internal error: {type(error).__name__}: {error}", "hint": ""}


def _report(shape: Shape, folder: Path) -> dict[str, Any]:
    notes, size = list(shape.source.get("notes", [])), largest_extent(shape)
    if not USUAL[0] <= size <= USUAL[1]:
        notes.append(f"it is {size:.3g} m wide; where that is wrong, --units says what the file counts in")
    known = {"folder": str(folder), "volume_m3": shape.volume, "nodes": len(shape.nodes), "notes": notes}
    return known | shape.certificate


def _load(file: Path, options: Options) -> Mesh:
    """The mesh of a file in metres."""
    mesh = load_mesh(file)
    return replace(mesh, vertices=mesh.vertices * UNITS[options.units])


def _request(mesh: Mesh, options: Options) -> str:
    """Changes with everything that a fit depends on; a file names others, so its own bytes do not tell."""
    return hashlib.sha256(f"{mesh.digest()}|{options}|{FIT_VERSION}".encode()).hexdigest()


def _kept(file: Path, folder: Path, options: Options) -> dict[str, Any] | None:
    """The report of a shape folder that holds just what this fit would make, or None."""
    try:
        made_for = read_json(folder / RECORD_FILE)["source"]["request"]
        if made_for != _request(_load(file, options), options):
            return None
        shape = load_shape(folder)
    except (SdfsimError, OSError, KeyError, TypeError, AttributeError):
        return None
    return _report(shape, folder)
