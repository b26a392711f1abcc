"""The fit command: turns one or many mesh files into shape folders."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from sdfsim.base.console import duration
from sdfsim.base.devices import pick_device
from sdfsim.base.errors import SdfsimError, warn_once
from sdfsim.base.files import check_writable, locked, read_json, visible
from sdfsim.base.parallel import Progress, parallel, silent
from sdfsim.geometry.mesh_io import MESH_SUFFIXES, load_textured
from sdfsim.scene.schema import UNITS
from sdfsim.sdf.baked_grid import baked, grid_certificate, unseen_wall
from sdfsim.sdf.fit import FIT_VERSION, Recipe
from sdfsim.shape.make import dressed, far_origin, fit_mesh, remarks
from sdfsim.shape.shape import RECORD_FILE, Shape, load_shape

ERRORS = ("error_within_0.01", "error_within_0.1", "error_in_box", "projected_from_0.01", "sign_errors")


@dataclass(frozen=True)
class Options:
    """How meshes are fitted; see `fit_mesh`. `units` are the units of the mesh files, as in scene.yaml (None:
    metres)."""

    recipe: Recipe = "default"
    budget: float | None = None
    cap: bool = False
    thicken: float | None = None
    units: Literal["m", "cm", "mm", "in"] | None = None


def fit(
    source: Path | str | Sequence[Path | str],
    out: Path | str,
    *,
    recipe: Recipe = "default",
    budget: float | None = None,
    cap: bool = False,
    thicken: float | None = None,
    units: Literal["m", "cm", "mm", "in"] | None = None,
    device: str = "auto",
    on_progress: Progress = silent,
) -> dict[str, Any]:
    """Fit a mesh file and write the shape folder `out`; or fit several files, or those of a folder, into `out`/NAME.

    Args:
        recipe: how networks are fitted: "quick" or "default".
        budget: s, time limit of one fit.
        cap: close openings of any size.
        thicken: m, the thickness that an open sheet gets.
        units: of the mesh files; None: metres.
        device: "cpu", "cuda" or "auto".

    Returns the report of `fit_file` or of `fit_many`. Raises SdfsimError if the mesh cannot be used, if a folder cannot
    be written, or if there are no meshes; of several meshes, the report says which cannot be used.
    """
    options = Options(recipe, budget, cap, thicken, units)
    sources = [Path(source)] if isinstance(source, Path | str) else [Path(one) for one in source]
    if len(sources) == 1 and not sources[0].is_dir():
        report = fit_file(sources[0], Path(out), options, device=device, on_progress=on_progress)
        found = {Path(out).name: report}
    else:
        report = fit_many(named_meshes(sources), Path(out), options, device=device, on_progress=on_progress)
        found = report["shapes"]
    if on_progress is silent:
        for name, one in found.items():
            for note in one.get("notes", []):
                warn_once(f"{name}: {note}")
    return report


def fit_file(mesh_file: Path, out: Path, options: Options, *, device: str, on_progress: Progress) -> dict[str, Any]:
    """Fit a mesh file and write the shape folder `out`, unless it exists with the same mesh and options. The report has
    the folder, volume, number of nodes, what was done to the mesh, the certificate, and in `failed_checks` whether the
    fit missed it. Raises SdfsimError if the mesh cannot be used, the folder cannot be written, or another run is
    writing to it."""
    where, loaded = pick_device(device), load_textured(mesh_file)
    mesh = loaded.mesh
    metres = UNITS[options.units or "m"]
    remarked = remarks(mesh_file, mesh, metres, given=options.units is not None)
    mesh = replace(mesh, vertices=mesh.vertices * metres)
    # A mesh file may name others, so its own bytes are not enough.
    skin, lost = dressed(loaded, thicken=options.thicken)
    skin = skin and replace(skin, vertices=skin.vertices * metres)
    far = far_origin(mesh)
    remarked = [*lost, *remarked, *([far] if far else [])]
    described = mesh.digest() + ("" if skin is None else skin.digest())
    request = hashlib.sha256(f"{described}|{options}|{FIT_VERSION}".encode()).hexdigest()
    check_writable(out)
    shape = _kept(out, request)
    if shape is None:
        with locked(out):
            how = {key: value for key, value in vars(options).items() if key != "units"}
            how |= {"name": out.resolve().name, "file": str(mesh_file), "device": where}
            shape = fit_mesh(mesh, **how, on_progress=on_progress)
            certificate = shape.certificate | grid_certificate(shape.sdf, shape.nodes)
            wall = unseen_wall(shape.sdf, baked(shape.sdf, shape.nodes))
            source = shape.source | {"request": request}
            if wall is not None:
                thin = f"walls of at most {wall:.2g} m: bodies may pass through them; --thicken helps"
                source["notes"] = [*source.get("notes", []), thin]
            shape = replace(shape, source=source, certificate=certificate, skin=skin)
            shape.save(out)
    missed = [] if shape.certificate["passed"] else [f"fit: {shape.certificate['reason']}"]
    notes = [*shape.source.get("notes", []), *remarked]
    known = {"folder": str(out), "volume_m3": shape.volume, "nodes": len(shape.nodes), "notes": notes}
    return known | shape.certificate | {"failed_checks": missed}


def _kept(folder: Path, request: str) -> Shape | None:
    try:
        made_for = read_json(folder / RECORD_FILE)["source"]["request"]
        return load_shape(folder) if made_for == request else None
    except (SdfsimError, KeyError, TypeError):
        return None


def fit_lines(report: dict[str, Any]) -> list[str]:
    """A report of `fit` as lines of text; for several meshes every line begins with the shape's name."""
    if "shapes" in report:
        lines = [f"{name}: {line}" for name, found in report["shapes"].items() for line in fit_lines(found)]
        return [*lines, f"wrote {report['folder']}"]
    if "error" in report:
        return [f"failed: {report['error']}"]
    errors = ", ".join(f"{key.replace('_', ' ')} {report[key]:.2g}" for key in ERRORS if report.get(key) is not None)
    return [
        *report["notes"],
        f"errors relative to the size: {errors}",
        f"{report['nodes']} nodes, volume {report['volume_m3']:.4g} m^3, {duration(report['seconds'])}",
        f"wrote {report['folder']}",
    ]


def named_meshes(sources: list[Path]) -> dict[str, Path]:
    """Mesh files, including those in folders, by the names of their shapes: the file's name without suffix or, if
    several files share it, the name of the file's folder. Raises SdfsimError for no meshes, or for two with the same
    name."""
    files: list[Path] = []
    for source in sources:
        inside = visible(source) if source.is_dir() else [source]
        found = [file for file in inside if file == source or file.suffix.lower() in MESH_SUFFIXES]
        if not found:
            raise SdfsimError(f"{source}: no mesh files in this folder", "it takes " + " ".join(MESH_SUFFIXES))
        files += found
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

    Returns `shapes`, by name the report of `fit_file` or the `error` that prevented the fit; and in `failed_checks` the
    shapes that missed their certificate.
    """
    where, names = pick_device(device), list(meshes)
    check_writable(out)
    jobs = [(file, out / name, options, str(where)) for name, file in meshes.items()]
    made = enumerate(_fit_one(*job) for job in jobs) if where.type == "cuda" else parallel(_fit_one, jobs)
    reports = {}
    for done, (index, report) in enumerate(made, start=1):
        reports[names[index]] = report
        how = "failed" if "error" in report else "fitted" if report["passed"] else "missed"
        on_progress(done / len(jobs), f"{names[index]}: {how}, {done} of {len(jobs)}")
    missed = [f"{name}: {reports[name]['reason']}" for name in names if reports[name].get("passed") is False]
    return {"folder": str(out), "shapes": {name: reports[name] for name in names}, "failed_checks": missed}


def _fit_one(file: Path, folder: Path, options: Options, device: str) -> dict[str, Any]:
    """A report, or the error: a failure of one mesh must not stop the others."""
    try:
        return fit_file(file, folder, options, device=device, on_progress=silent)
    except SdfsimError as error:
        return {"error": error.message}
    except Exception as error:
        return {"error": f"internal error: {type(error).__name__}: {error}"}
