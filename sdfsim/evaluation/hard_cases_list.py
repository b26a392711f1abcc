"""The hard cases: which scenes, what is measured on them, and what is wanted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import atan, degrees
from pathlib import Path

from sdfsim.errors import SdfsimError
from sdfsim.evaluation import hard_cases_measures as measure
from sdfsim.evaluation import hard_cases_scenes as scenes
from sdfsim.evaluation.hard_cases import Case, Figure
from sdfsim.scene.types import Scene
from sdfsim.shape.mesh import MESH_SUFFIXES
from sdfsim.shape.shape import Shape, shape_from_mesh, shape_from_primitive

FEWEST = 2  # repetitions: there is no spread of one
YAWS = (0.0, 37.0, 121.0, 245.0)  # degrees
SPEEDS = (1.0, 5.0, 20.0, 50.0)  # m/s
TOWERS = (3, 5, 10, 20)
RATIOS = (1.0, 10.0, 100.0, 1000.0)
RESTITUTIONS = (0.0, 0.3, 0.5, 0.7, 0.9)
FRICTIONS = (0.2, 0.4, 0.6)
OFFSETS = (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0)  # degrees from the angle at which a body begins to slide


def cases(*, quick: bool = False, shapes: Path | None = None) -> list[Case]:
    """Every case, in the order of the list.

    Args:
        quick: fewer and shorter ones: two repetitions, no pile of 512, ten seconds of rest for sixty, a tenth of the
            random scenes.
        shapes: folder of meshes that are to rest on the floor too, each scaled to a largest extent of 1 m.

    Raises:
        SdfsimError: the folder holds no meshes, or one that cannot be used.
    """
    found = [
        *_yaw(quick),
        *_overlaps(),
        *_thin(),
        *_resting(quick, shapes),
        *_stacks(),
        *_masses(),
        *_bounces(),
        *_slopes(quick),
        *_piles(quick),
        *_energy(quick),
        *_precision(quick),
    ]
    return [replace(case, repeats=min(case.repeats, FEWEST)) if quick else case for case in found]


def _yaw(quick: bool) -> list[Case]:
    yaws = YAWS[:2] if quick else YAWS

    def turned(repeat: int) -> list[Scene]:
        bases = [scenes.tossed((6, repeat, k)) for k in range(2)]
        return [scenes.yawed(base, yaw) for base in bases for yaw in yaws]

    back = partial(measure.turned_back, degrees=yaws)
    figures = (Figure("deviation", "% of size", 5, largest=True),)
    return [Case("yaw", "yaw", "random scenes, 50 steps", turned, back, figures, steps=50)]


def _overlaps() -> list[Case]:
    box, ball = scenes.box(1.0), scenes.ball()
    built = {
        "overlap-boxes": ("two boxes, half in each other", scenes.overlapping(box, box, 0.5)),
        "overlap-balls": ("two balls, half in each other", scenes.overlapping(ball, ball, 0.5)),
        "coincident-boxes": ("two boxes in one place", scenes.overlapping(box, box, 0.0)),
        "coincident-balls": ("two balls in one place", scenes.overlapping(ball, ball, 0.0)),
        "coincident-both": ("a box and a ball in one place", scenes.overlapping(box, ball, 0.0)),
        "sunk-box": ("a box, half in the floor", scenes.sunk(box)),
    }
    figures = (Figure("exit speed", "m/s", 2, limit=3.0), Figure("depth left", "% of size", 1))
    return [
        Case(name, "overlap", title, _one(scene), measure.separated, figures, seconds=1.0)
        for name, (title, scene) in built.items()
    ]


def _thin() -> list[Case]:
    figures = (Figure("through", "%", 0, limit=0.0),)
    return [
        Case(
            f"thin-{speed:g}",
            "thin",
            f"{speed:g} m/s",
            lambda repeat, speed=speed: [scenes.thrown_at_plate(speed, repeat)],
            measure.passed,
            figures,
            seconds=0.6,
            x=speed,
        )
        for speed in SPEEDS
    ]


def _resting(quick: bool, shapes: Path | None) -> list[Case]:
    times = (10.0,) if quick else (10.0, 60.0)
    built = {
        "box": scenes.box(1.0),
        "ball": scenes.ball(),
        "knot": shape_from_primitive("torus_knot", sdf="grid", name="knot"),
        **(_meshes(shapes) if shapes else {}),
    }
    drifts = tuple(Figure(f"drift {t:g} s", "% of size", 2, limit=1.0) for t in times)
    awake = (*drifts, Figure("speed", "m/s", 4, limit=0.01), Figure("height", "%", 2, limit=5.0))
    asleep = (Figure("motion", "m", 9, limit=0.0), drifts[0])
    found = []
    for name, shape in built.items():
        for sleep, figures in ((False, awake), (True, asleep)):
            found.append(
                Case(
                    f"rest-{name}{'-sleep' if sleep else ''}",
                    "rest",
                    f"{name}, sleep {'on' if sleep else 'off'}",
                    _one(scenes.resting(shape, sleep=sleep)),
                    partial(measure.rest, times=times[:1] if sleep else times),
                    figures,
                    seconds=times[0] if sleep else times[-1],
                    repeats=2,
                    teacher=not sleep,
                )
            )
    return found


def _meshes(folder: Path) -> dict[str, Shape]:
    files = sorted(f for f in folder.glob("*") if f.suffix.lower() in MESH_SUFFIXES)
    if not files:
        raise SdfsimError(f"{folder}: no meshes found", f"expected {', '.join(sorted(MESH_SUFFIXES))}")
    found = {}
    for file in files:
        extent = measure.largest_extent(shape_from_mesh(file, sdf="mesh"))
        found[file.stem] = shape_from_mesh(file, sdf="grid", units=1.0 / extent)
    return found


def _stacks() -> list[Case]:
    figures = (Figure("fallen", "bodies", 1, limit=0.0), Figure("shift", "% of size", 1))
    built = {f"tower-{n}": (f"tower of {n}", scenes.tower(n), float(n)) for n in TOWERS} | {
        "pyramid": ("pyramid of 10 cubes", scenes.pyramid(), None),
        "wall": ("wall of 22 bricks", scenes.wall(), None),
        "cards": ("two cards that lean on each other", scenes.card_house(), None),
    }
    return [
        Case(name, "stack", title, _one(scene), measure.standing, figures, x=x)
        for name, (title, scene, x) in built.items()
    ]


def _masses() -> list[Case]:
    figures = (Figure("worst depth", "% of size", 1), Figure("fallen", "bodies", 1, limit=0.0))
    return [
        Case(
            f"mass-{ratio:g}",
            "mass",
            f"{ratio:g} kg on 1 kg",
            _one(scenes.heavy_on_light(ratio)),
            measure.squeezed,
            figures,
            x=ratio,
        )
        for ratio in RATIOS
    ]


def _bounces() -> list[Case]:
    figures = (Figure("error", "% of drop", 1, limit=5.0), Figure("rebound", "% of drop", 1, judged=False))
    return [
        Case(
            f"bounce-{e:g}",
            "bounce",
            f"e = {e:g}: {100 * e * e:.0f} % wanted",
            lambda repeat, e=e: [scenes.dropped(e, repeat)],
            partial(measure.rebound, restitution=e),
            figures,
            seconds=1.3,
            x=e,
        )
        for e in RESTITUTIONS
    ]


def _slopes(quick: bool) -> list[Case]:
    offsets = OFFSETS[::2] if quick else OFFSETS
    figures = (Figure("error", "degrees", 1, limit=2.0), Figure("slips at", "degrees", 1, judged=False))
    return [
        Case(
            f"slope-{mu:g}",
            "slope",
            f"mu = {mu:g}: atan(mu) = {_critical(mu):.1f} degrees",
            lambda repeat, mu=mu: [scenes.nudged(scenes.slope(mu, _critical(mu) + off), repeat) for off in offsets],
            partial(measure.slipped, friction=mu, offsets=offsets),
            figures,
            seconds=2.0,
            repeats=2,
            x=mu,
        )
        for mu in FRICTIONS
    ]


def _critical(friction: float) -> float:
    return degrees(atan(friction))


def _piles(quick: bool) -> list[Case]:
    figures = (
        Figure("depth 95 %", "% of size", 1),
        Figure("through the wall", "bodies", 1, limit=0.0),
        Figure("energy gain", "%", 1, limit=1.0),
    )
    return [
        Case(
            f"pile-{count}",
            "pile",
            f"{count} bodies",
            lambda repeat, count=count: [scenes.piled(count, repeat)],
            measure.heaped,
            figures,
            seconds=2.0,
            repeats=repeats,
            x=count,
        )
        for count, repeats in ((64, 2),) + (() if quick else ((512, 1),))
    ]


def _energy(quick: bool) -> list[Case]:
    each, repeats = (10, FEWEST) if quick else (50, 4)
    figures = (Figure("steps with gain", "%", 2), Figure("worst gain", "% of start", 2, largest=True))
    return [
        Case(
            "energy",
            "energy",
            f"{repeats * each} scenes of 3 to 8 bodies",
            lambda repeat: [scenes.tossed((20, repeat, k)) for k in range(each)],
            measure.created,
            figures,
            seconds=2.0,
            repeats=repeats,
        )
    ]


def _precision(quick: bool) -> list[Case]:
    figures = (Figure("diverges after", "s", 2, longer=True),)
    count = 2 if quick else 4

    def plain(repeat: int) -> list[Scene]:
        return [scenes.tossed((22, repeat, k)) for k in range(count)]

    def off(repeat: int) -> list[Scene]:
        return [*plain(repeat), *(scenes.started_off(scene, 1e-6) for scene in plain(repeat))]

    case = Case("start-off", "precision", "start 1e-6 m/s off", off, measure.diverged, figures, seconds=3.0, repeats=2)
    other = replace(case, scenes=plain, teacher=False)
    return [
        case,
        replace(other, name="bfloat16", title="network in bfloat16", variant="bfloat16"),
        replace(other, name="cuda", title="on CUDA", variant="cuda"),
    ]


def _one(scene: Scene) -> Callable[[int], list[Scene]]:
    return lambda repeat: [scenes.nudged(scene, repeat)]
