"""Recorded motions of a scene from trackers and runs: reads them, removes faults of trackers, and finds velocities by
fits through smooth stretches."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np

from sdfsim.apps.export_joints import Held, trees
from sdfsim.apps.run import read_run
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import not_read, read_arrays, visible
from sdfsim.base.parallel import Progress, silent
from sdfsim.physics import pose
from sdfsim.physics.bodies import from_scene, largest_extent
from sdfsim.physics.free_flight import torque_free
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options
from sdfsim.physics.rollout import Rollout
from sdfsim.physics.steps import Frames
from sdfsim.physics.units import scene_units
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Body, Scene
from sdfsim.simulate.batch import Copies, inner_of_frame

COLUMNS = ("time", "body", "x", "y", "z", "qx", "qy", "qz", "qw")
ARRAYS = ("position", "quat_xyzw")  # arrays in an npz of poses, besides `dt` or `time`, and `names` and `start`
SLOWEST = 1.0  # s between frames: nothing that falls is seen with fewer
EVEN = 0.1  # relative to the spacing: how far a time may be off an even grid
NEAR, LEAST = 3, 5  # frames on each side that decide whether a frame is in smooth motion; frames of the shortest flight
BEYOND = 5.0  # standard deviations beyond which a difference is not noise
# Trackers that smooth have larger errors over a flight than from frame to frame: at most this much, relative to the
# size (and in rad), and this many standard deviations of that.
ROUGH, SMOOTHED = 3e-3, 30.0
LEVER = 2.0  # factor on trackers' errors for trees: the positions of its bodies depend on each other's rotations
MOVING = 0.05  # relative to the fastest frames of a recording: slower ones may be at rest
FINEST = 2e-6  # relative to a body's size (and in rad): poses are not expected to be more exact
WEIGHTLESS = 0.25  # relative to gravity: a body whose acceleration differs by less may be in free flight
ROUNDS = 4  # Gauss-Newton rounds for a flight's rotation
TOGETHER = 32  # flights of trees that are fitted side by side, limited by the memory for their paths
LOST = 3  # frames: the longest excursion of a tracker that can be distinguished from an impact
# For the flight of a tree: Gauss-Newton rounds; frames from which the fit starts; ways to change it that are weaker
# than this, relative to the strongest, are those that joints do not allow; and poses that are farther off than this
# many standard deviations count less than squared.
SWINGS, BEGIN, SINGULAR, SLACK = 5, 8, 1e-3, 3.0

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # those of a `Motion`


@dataclass(frozen=True)
class Recording:
    """T poses of the D moving bodies, evenly spaced in time, and the velocities that were found."""

    name: str
    dt: float  # s
    position: np.ndarray  # [T, D, 3] m, of the centres of mass; from the fit if there is one
    orientation: np.ndarray  # [T, D, 4] xyzw, likewise
    # velocity, angular_velocity: [T, D, 3] m/s and rad/s
    velocity: np.ndarray
    angular_velocity: np.ndarray
    known: np.ndarray  # [T] bool, whether the velocities of all bodies can be trusted
    flying: np.ndarray  # [T, D] bool, whether a body is in free flight
    seen: np.ndarray  # [T, D] bool, whether there is a pose
    goal: tuple[np.ndarray, np.ndarray]  # the poses as recorded, [T, D, 3] and [T, D, 4]
    noise: tuple[float, float] = (0.0, 0.0)  # m and rad, standard deviations of poses from smooth motion
    lost: int = 0  # number of poses that were missing or not numbers
    jumps: int = 0  # number of poses that were left out because no motion leads there and back
    # Of films: small motions [6] of a pose `goal` (m and rad, world axes) and changes of the camera [C] (in standard
    # deviations) are as likely as root [T, D, 6, 6] @ motion + rest [T, D, 6] + camera [T, D, 6, C] @ change is small.
    # `late` [T] s: when the frame was taken, after the time of its row.
    root: np.ndarray | None = None
    rest: np.ndarray | None = None
    camera: np.ndarray | None = None
    late: np.ndarray | None = None


def movers(scene: Scene) -> list[Body]:
    """The moving bodies of a scene, which recordings are about. Raises SdfsimError if none moves."""
    found = [b for b in scene.bodies if b.motion == "dynamic"]
    if not found:
        raise SdfsimError(f"{scene.path}: bodies: none moves")
    return found


def load_recordings(
    paths: Sequence[Path],
    scene_file: Path | None = None,
    *,
    only: int | None = None,
    allow_outside: bool = False,
    on_progress: Progress = silent,
) -> tuple[list[Recording], Scene]:
    """Read recordings of one scene, and the scene. They may be run folders and `rollout.npz` files, whose scene is
    known; CSVs and `npz` files of poses, with positions of the shapes' own origins, as in a scene file; and folders of
    these. `only` selects one recording of a file with many. Raises SdfsimError if there is no scene, if files are
    unreadable, or if a recording is not of this scene."""
    files = [file for path in paths for file in _files(path)]
    scene, found = None, []
    if scene_file is not None:
        scene = load_scene(scene_file, on_progress, allow_outside=allow_outside)
    for file in files:
        poses = file.suffix == ".csv" or (file.suffix == ".npz" and "meta" not in read_arrays(file, "a recording"))
        if not poses:
            own, rollout = read_run(
                file, scene.path if scene else None, allow_outside=allow_outside, on_progress=on_progress
            )
            scene = scene or own
            rows = [k for k, b in enumerate(own.bodies) if b in movers(own)]
            place, turn, speed, spin = (getattr(rollout, name)[:, rows] for name in MOTION)
            dt, sure = float(np.diff(rollout.time).mean()) if len(rollout) else 0.0, np.ones(place.shape[:2], bool)
            found.append(Recording(str(file), dt, place, turn, speed, spin, sure[:, 0], ~sure, sure, (place, turn)))
        elif scene is None:
            raise SdfsimError(f"{file}: a recording without its scene", "give its scene: --scene scene.yaml")
        else:
            names = [body.name for body in movers(scene)]
            read = _csv(file, names) if file.suffix == ".csv" else _npz(file, names)
            if only is not None and only >= len(read):
                raise SdfsimError(f"{file}[{only}]: there are {len(read)} recordings", f"0 to {len(read) - 1}")
            read = read if only is None else read[only : only + 1]
            found += [cleaned(name, dt, poses, scene) for name, dt, poses in read]
    if scene is None:
        raise SdfsimError("no recordings", "give run folders, or CSV or npz files of poses")
    return with_velocities(found, scene), scene


def load_beside(
    path: Path, scene_file: Path, *, allow_outside: bool = False, on_progress: Progress = silent
) -> Rollout:
    """Read one recording, to simulate a scene beside it (see `beside`): a run, a file of poses, or `FILE[K]` for one of
    many in a file. It begins with the first frame whose velocities are known. Raises SdfsimError as `load_recordings`
    does, and also if the file has several recordings and none is selected, or if no velocities are known."""
    numbered = None if path.exists() else re.fullmatch(r"(.+)\[(\d+)\]", str(path))
    file, only = (Path(numbered[1]), int(numbered[2])) if numbered else (path, None)
    found, scene = load_recordings([file], scene_file, only=only, allow_outside=allow_outside, on_progress=on_progress)
    if len(found) > 1:
        raise SdfsimError(f"{path}: {len(found)} recordings", f"say which one, such as {found[0].name}")
    one = found[0]
    if not one.known.any():
        raise SdfsimError(f"{one.name}: no stretch is smooth enough to find a velocity", "give a longer recording")
    first = int(one.known.argmax())
    frames = first + np.flatnonzero(one.seen[first:].all(1))
    place, turn = (poses[frames] for poses in one.goal)
    place[0], turn[0] = one.position[first], one.orientation[first]
    none = np.zeros((0, 3))
    return Rollout(
        one.dt * (frames - first), place, turn, one.velocity[frames], one.angular_velocity[frames],
        np.zeros(len(frames), np.int64), none, none[:, :2].astype(np.int64),
        names=tuple(body.name for body in movers(scene)), meta={"recording": one.name},
    )  # fmt: skip


def _files(path: Path) -> list[Path]:
    if not path.is_dir() or (path / "rollout.npz").exists():
        return [path]
    found = [f for f in visible(path) if f.suffix in (".csv", ".npz") or (f / "rollout.npz").exists()]
    if not found:
        raise SdfsimError(f"{path}: no recordings in this folder", "it may hold CSVs, npz files and run folders")
    return found


def _csv(path: Path, moving: list[str]) -> list[tuple[str, float, np.ndarray]]:
    """Spacing in s and poses [T, D, 7] of the bodies, positions [m] before quaternions; NaN for missing poses."""
    rows: dict[tuple[float, str], list[float]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise SdfsimError(f"{path}:1: columns must be {','.join(COLUMNS)}")
            for row in reader:
                if row["body"] in moving:
                    where, numbers = f"{path}:{reader.line_num}: ", []
                    for name in ("time", *COLUMNS[2:]):
                        try:
                            numbers.append(float(row[name] or ("" if name == "time" else "nan")))
                        except ValueError:
                            raise SdfsimError(f"{where}{name}: must be a number (got {row[name]!r})") from None
                    if not np.isfinite(numbers[0]):
                        raise SdfsimError(f"{where}time: must be finite (got {row['time']!r})")
                    if (numbers[0], row["body"]) in rows:
                        raise SdfsimError(f"{where}body: {row['body']!r} has two poses at time {numbers[0]:g}")
                    rows[numbers[0], row["body"]] = numbers[1:]
    except (OSError, csv.Error, UnicodeDecodeError) as error:
        raise SdfsimError(
            f"{path}: {not_read(error, 'a CSV of poses')}", "give poses as .csv or .npz, or a run folder"
        ) from error
    if missing := set(moving) - {name for _, name in rows}:
        raise SdfsimError(f"{path}: body: no pose of {min(missing)!r}, which the scene has")
    times = np.unique([time for time, _ in rows])
    poses = np.full((len(times), len(moving), 7), np.nan)
    for (time, name), values in rows.items():
        poses[np.searchsorted(times, time), moving.index(name)] = values
    return [(str(path), *_on_grid(path, times, poses))]


def _npz(path: Path, moving: list[str]) -> list[tuple[str, float, np.ndarray]]:
    """As `_csv`; many recordings, stored end to end, if there is a `start` [K+1]."""
    data = read_arrays(path, "a recording")

    def wrong(name: str, what: str) -> SdfsimError:
        return SdfsimError(f"{path}: {name}: {what}")

    if missing := [name for name in ARRAYS if name not in data]:
        raise wrong(missing[0], f"there is no such array (it has {', '.join(sorted(data))})")
    arrays = []
    for name, width in zip(ARRAYS, (3, 4), strict=True):
        values = np.asarray(data[name])
        values = values[:, None] if values.ndim == 2 else values
        if values.dtype.kind not in "fiu" or values.ndim != 3 or values.shape[2] != width:
            raise wrong(name, f"must be numbers [T, bodies, {width}] (got {data[name].dtype} {data[name].shape})")
        arrays.append(values.astype(np.float64))
    names = [str(name) for name in data["names"]] if "names" in data else moving
    if len({len(names), *(array.shape[1] for array in arrays)}) > 1 or len(arrays[0]) != len(arrays[1]):
        raise wrong(ARRAYS[1], f"must have as many poses as position, and {len(names)} bodies")
    if missing := set(moving) - set(names):
        raise wrong("names", f"no body {min(missing)!r}, which the scene has")
    poses = np.concatenate(arrays, -1)[:, [names.index(name) for name in moving]]
    ends = np.asarray(data.get("start", [0, len(poses)]))
    if ends.dtype.kind not in "iu" or ends.ndim != 1 or len(ends) < 2 or ends[0] != 0 or ends[-1] != len(poses):
        raise wrong("start", f"must be whole numbers from 0 to {len(poses)}")
    if (np.diff(ends) <= 0).any():
        raise wrong("start", "must increase")
    if "time" in data:
        times = np.asarray(data["time"], dtype=np.float64)
        if times.shape != (len(poses),) or not np.isfinite(times).all():
            raise wrong("time", f"must be {len(poses)} finite numbers")
    elif np.size(data.get("dt", ())) == 1 and 0.0 < float(data["dt"]) < np.inf:
        times = float(data["dt"]) * np.arange(len(poses))
    else:
        raise wrong("dt", "must be one number above 0, in s, if there is no time")
    cuts = [slice(a, b) for a, b in pairwise(ends)]
    names = [f"{path}[{k}]" if len(cuts) > 1 else str(path) for k in range(len(cuts))]
    return [(name, *_on_grid(name, times[cut], poses[cut])) for name, cut in zip(names, cuts, strict=True)]


def _on_grid(path: Path | str, times: np.ndarray, poses: np.ndarray) -> tuple[float, np.ndarray]:
    """Spacing in s, and poses at even times, NaN for missing ones."""
    if len(times) < LEAST:
        raise SdfsimError(f"{path}: time: {len(times)} times (at least {LEAST})")
    gaps = np.diff(times)
    if (gaps <= 0.0).any():
        raise SdfsimError(f"{path}: time: must increase (frame {int((gaps <= 0.0).argmax()) + 1})")
    dt = float(np.median(gaps))
    if dt > SLOWEST:
        raise SdfsimError(f"{path}: time: frames are {dt:.3g} s apart (at most {SLOWEST:g})", "times are in seconds")
    dt = float(np.ptp(times)) / max(1, round(np.ptp(times) / dt))
    frame = np.round((times - times[0]) / dt).astype(int)
    off = np.abs((times - times[0]) / dt - frame)
    if off.max() > EVEN or (np.diff(frame) < 1).any():
        found = f"they are {gaps.min():.4g} to {gaps.max():.4g} s apart"
        raise SdfsimError(f"{path}: time: must be evenly spaced, except for missing frames ({found})")
    if frame[-1] + 1 > 100 * len(times):
        raise SdfsimError(f"{path}: time: {frame[-1] + 1 - len(times)} of {frame[-1] + 1} frames are missing")
    whole = np.full((frame[-1] + 1, *poses.shape[1:]), np.nan)
    whole[frame] = poses
    return dt, whole


def cleaned(name: str, dt: float, poses: np.ndarray, scene: Scene) -> Recording:
    """A recording of poses [T, D, 7] without faults of trackers: rows without numbers, flipping signs of quaternions,
    and excursions of up to `LOST` frames. Its velocities are not found yet."""
    bodies = movers(scene)
    length = np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    seen = np.isfinite(poses).all(-1) & (length[..., 0] > 0.0) & np.isfinite(length[..., 0])
    turn = np.where(seen[..., None], poses[..., 3:] / np.where(seen[..., None], length, 1.0), [0.0, 0.0, 0.0, 1.0])
    com = np.array([scene.shapes[b.shape].com * b.scale for b in bodies])
    position = np.where(seen[..., None], poses[..., :3], 0.0) + pose.rotate(turn, com)
    size = np.array([largest_extent(scene.shapes[b.shape]) * b.scale for b in bodies])
    lost, before = int((~seen).sum()), int(seen.sum())
    for d in range(len(bodies)):
        rows = np.flatnonzero(seen[:, d])
        if len(rows) < LEAST:
            raise SdfsimError(f"{name}: body {bodies[d].name!r}: {len(rows)} poses (at least {LEAST})")
        turn[rows, d] = _same_sign(turn[rows, d])
        away = _excursions(np.concatenate([position[rows, d] / size[d], turn[rows, d]], 1))
        seen[rows[away], d] = False
        rows = rows[~away]
        turn[rows, d] = _same_sign(turn[rows, d])
    none = np.zeros(position.shape)
    return Recording(
        name, dt, position, turn, none, none, np.zeros(len(poses), bool), ~seen & False, seen, (position, turn),
        lost=lost, jumps=before - int(seen.sum()),
    )  # fmt: skip


def _same_sign(turn: np.ndarray) -> np.ndarray:
    """Quaternions [T, 4], each with the sign nearer to the one before."""
    signs = np.where((turn[1:] * turn[:-1]).sum(1) < 0.0, -1.0, 1.0)
    return turn * np.concatenate([[1.0], np.cumprod(signs)])[:, None]


def _excursions(x: np.ndarray) -> np.ndarray:
    """[T] bool: poses x [T, 7] of an excursion. They are farther from the line between the poses before and after than
    a motion with the speeds there can lead: an impact changes a velocity, but not a position."""
    away, floor = np.zeros(len(x), bool), 20.0 * FINEST
    for part in (x[:, :3], x[:, 3:]):
        step = np.linalg.norm(np.diff(part, axis=0), axis=1)
        usual = float(np.median(step)) + floor
        for count in range(1, LOST + 1):
            for t in range(1, len(x) - count):
                if away[t : t + count].any():
                    continue
                # Ends have a neighbour on one side only, and a neighbour that is itself on an excursion tells nothing.
                ahead = step[t - 2] if t > 1 and not away[t - 2] else usual
                behind = step[t + count] if t + count < len(step) and not away[t + count + 1] else usual
                bound = 2.0 * (ahead + behind + usual) * 0.5 * (count + 1)
                first, last = part[t - 1], part[t + count]
                share = np.arange(1, count + 1)[:, None] / (count + 1)
                off = np.linalg.norm(part[t : t + count] - (first + share * (last - first)), axis=1)
                if (off > bound).all() and np.linalg.norm(last - first) < bound * (count + 1):
                    away[t : t + count] = True
    return away


# --- velocities ---


def with_velocities(recordings: list[Recording], scene: Scene) -> list[Recording]:
    """The recordings with the velocities of their smooth stretches. In flights they come from a parabola and a
    torque-free rotation through the whole flight (for bodies that joints hold together, from the motion of all of
    them); elsewhere (sliding, rolling, rest) from a polynomial through the frames nearby. Those of a run are known."""
    bodies = movers(scene)
    inertia = from_scene(replace(scene, bodies=tuple(bodies), joints=()), scene_units(scene))[0].inertia
    size = [largest_extent(scene.shapes[b.shape]) * b.scale for b in bodies]
    gravity, done, flights = np.asarray(scene.gravity), [], []
    bound = jointed(scene)
    for r in recordings:
        if r.known.any():
            done.append(r)
            continue
        arrays = [a.copy() for a in (r.position, r.orientation, r.velocity, r.angular_velocity)]
        smooth, flying, noise = np.zeros(r.seen.shape, bool), np.zeros(r.seen.shape, bool), []
        for d in range(len(bodies)):
            p, q = r.position[:, d], r.orientation[:, d]
            steps = (np.diff(p, axis=0), FINEST * size[d]), (_turns(q), FINEST)
            rows = _moving(r.seen[:, d], *steps)
            sigma = _noise(steps[0][0], rows, steps[0][1]), _noise(steps[1][0], rows, steps[1][1])
            noise.append(sigma)
            fitted, fits, flies = _nearby(p, q, r.seen[:, d], r.dt, gravity, sigma)
            smooth[:, d] = fits
            flies &= not bound[d]
            for whole, values in zip(arrays, fitted, strict=True):
                whole[fits, d] = values[fits]
            most = max(BEYOND * sigma[0], min(ROUGH * size[d], SMOOTHED * sigma[0]))
            for a, b in _flights(flies, r.seen[:, d], p, r.dt, gravity, most):
                rows = np.arange(a, b)[r.seen[a:b, d]]
                (arrays[0][a:b, d], arrays[2][a:b, d]), _ = _parabola(rows, p[rows], r.dt, gravity, np.arange(a, b))
                flying[a:b, d] = True
                flights.append((len(done), d, a, b, rows, fitted[3][a]))
        spread = np.sqrt(np.mean(np.square(noise), axis=0))
        done.append(
            replace(
                r, position=arrays[0], orientation=arrays[1], velocity=arrays[2], angular_velocity=arrays[3],
                known=(smooth | flying).all(1), flying=flying, noise=(float(spread[0]), float(spread[1])),
            )
        )  # fmt: skip
    _rotations(done, flights, inertia)
    done = [r if given.known.any() else _held(r, scene) for r, given in zip(done, recordings, strict=True)]
    for rows in flying_trees(scene):
        _swings(done, [k for k, given in enumerate(recordings) if not given.known.any()], rows, scene)
    return done


def _swings(done: list[Recording], numbers: Sequence[int], rows: list[int], scene: Scene) -> None:
    """Write the flights of bodies that joints hold together: their common centre of mass falls along a parabola, and
    they swing about it as the solve moves them. Stretches that do not fit this stay as they are."""
    tree = tree_of(scene, rows)
    mass = np.array([b.mass for b in tree.bodies])
    size = max(largest_extent(tree.shapes[b.shape]) * b.scale for b in tree.bodies)
    rough = LEVER * ROUGH
    gravity = np.asarray(scene.gravity)
    flights: dict[float, list[tuple[int, int, int, Swing]]] = {}
    for k in numbers:
        r, seen = done[k], np.asarray(done[k].seen[:, rows].all(1))
        place, turn = (array[:, rows] for array in r.goal)
        middle = (mass[:, None] * place).sum(1) / mass.sum()
        step = np.diff(middle, axis=0)
        sigma = _noise(step, _moving(seen, (step, FINEST * size)), FINEST * size), r.noise[1]
        flies = _nearby(middle, turn[:, 0], seen, r.dt, gravity, sigma)[2]
        most = max(BEYOND * sigma[0], min(rough * size, SMOOTHED * sigma[0]))
        for a, b in _flights(flies, seen, middle, r.dt, gravity, most):
            some = np.arange(a, b)[seen[a:b]]
            swing = Swing(r.dt * (some - a), place[some], turn[some], r.noise)
            flights.setdefault(r.dt, []).append((k, a, b, swing))
    parts = [(dt, some[c : c + TOGETHER]) for dt, some in flights.items() for c in range(0, len(some), TOGETHER)]
    for dt, some in parts:
        for (k, a, b, swing), (path, off, turned_off) in zip(some, swung([s for *_, s in some], dt, tree), strict=True):
            r, seen = done[k], a + np.round(swing.time / dt).astype(int)
            if off > max(BEYOND * r.noise[0], rough * size) or turned_off > max(BEYOND * r.noise[1], 2.0 * rough):
                continue  # something turned it
            middle = (mass[:, None] * swing.position).sum(1) / mass.sum()
            (at, fast), _ = _parabola(seen, middle, dt, gravity, np.arange(a, b))
            for whole, values, more in zip(
                (r.position, r.orientation, r.velocity, r.angular_velocity), path, (at, None, fast, None), strict=True
            ):
                whole[a:b, rows] = values if more is None else values + more[:, None]
            r.flying[a:b, rows] = True
            if len(rows) == r.seen.shape[1]:
                r.known[a:b] = True


def _held(r: Recording, scene: Scene) -> Recording:
    arrays = r.position, r.orientation, r.velocity, r.angular_velocity
    place, turn, speed, spin = held_together(arrays, scene) if scene.joints else arrays
    return replace(r, position=place, orientation=turn, velocity=speed, angular_velocity=spin)


def _noise(step: np.ndarray, rows: np.ndarray, least: float) -> float:
    """Standard deviation of poses from smooth motion, for each of three axes, from the changes of place or the turns
    `step` [T - 1, 3] between frames: by their second differences from frames `rows` on, the smoother third of which
    are hardly of impacts."""
    if not len(rows):
        return least
    third = step[rows + 2] - 2.0 * step[rows + 1] + step[rows]
    # The mean over the axes: if a motion is in a plane, some are exactly zero.
    each = np.quantile(np.abs(third), 1.0 / 3.0, axis=0) / (0.4307 * np.sqrt(20.0))
    return max(least, float(np.linalg.norm(each)) / np.sqrt(3.0))


def _moving(seen: np.ndarray, *steps: tuple[np.ndarray, float]) -> np.ndarray:
    """The frames from which four in a row are `seen` [T] and the body moves; all that are seen if it never does. Rest
    can be far stiller than poses are exact. `steps` are changes [T - 1, 3] between frames, each with the size of those
    that are rounding."""
    rows = np.flatnonzero(seen[3:] & seen[2:-1] & seen[1:-2] & seen[:-3])
    moves = np.zeros(len(rows), bool)
    for step, least in steps if len(rows) else ():
        fast = np.linalg.norm(np.stack([step[rows], step[rows + 1], step[rows + 2]]), axis=2).max(0)
        moves |= fast > max(MOVING * np.quantile(fast, 0.95), least)
    return rows[moves] if moves.any() else rows


def _turns(q: np.ndarray) -> np.ndarray:
    """[T - 1, 3] rad, the turns between orientations [T, 4]."""
    return pose.to_rotvec(pose.multiply(q[1:], pose.conjugate(q[:-1])))


def _nearby(
    p: np.ndarray, q: np.ndarray, seen: np.ndarray, dt: float, gravity: np.ndarray, sigma: tuple[float, float]
) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Pose and velocities of every frame by parabolas through `NEAR` frames on each side (more if they are noisy;
    one-sided at ends and impacts), whether these fit [T], and whether the frame may be in free flight [T]."""
    count, rows = len(p), np.flatnonzero(seen)
    out = p.copy(), q.copy(), np.zeros((count, 3)), np.zeros((count, 3))
    fits, flies = np.zeros(count, bool), np.zeros(count, bool)
    base = q[rows[np.clip(np.searchsorted(rows, np.arange(count)), 0, len(rows) - 1)]]
    strength = float(np.linalg.norm(gravity))
    # As many as needed for an acceleration that is certain to a sixteenth of gravity, given their noise.
    wanted = (430.0 * sigma[0] / (dt**2 * strength)) ** 0.4 if strength else 0.0
    near = int(np.clip(wanted / 2.0, NEAR, 5 * NEAR))
    for shift in (0, -near, near):  # symmetric first, then frames before, then frames after
        offset = np.arange(shift - near, shift + near + 1)
        frame = np.arange(count)[:, None] + offset
        there = (frame >= 0) & (frame < count)
        frame = np.clip(frame, 0, count - 1)
        there &= seen[frame]
        time = dt * offset
        powers = np.stack([np.ones_like(time), time, 0.5 * time**2], 1)
        enough = (there.sum(1) >= LEAST) & there[:, offset <= 0].any(1) & there[:, offset >= 0].any(1) & ~fits
        if not enough.any():
            continue
        t, weight = np.flatnonzero(enough), there[enough].astype(float)
        turn = pose.to_rotvec(pose.multiply(q[frame[t]], pose.conjugate(base[t])[:, None]))
        both = np.concatenate([p[frame[t]], turn], -1)
        inverse = np.linalg.inv(np.einsum("ki,tk,kj->tij", powers, weight, powers))
        fit = inverse @ np.einsum("ki,tk,tkc->tic", powers, weight, both)
        off = np.square(both - powers @ fit) * weight[..., None]
        off = np.sqrt(off.sum(1) / weight.sum(1)[:, None])
        good = off[:, :3].max(1) < BEYOND * sigma[0]
        turns = good & (off[:, 3:].max(1) < BEYOND * sigma[1])
        unsure = BEYOND * sigma[0] * np.sqrt(inverse[:, 2, 2])
        pull = np.linalg.norm(fit[:, 2, :3] - gravity, axis=1)
        fits[t[turns]], t, fit = True, t[good], fit[good]
        flies[t] = (pull[good] < np.maximum(unsure[good], WEIGHTLESS * strength)) & (pull[good] < 0.5 * strength)
        out[0][t], out[2][t], out[3][t] = fit[:, 0, :3], fit[:, 1, :3], fit[:, 1, 3:]
        out[1][t] = pose.multiply(pose.from_rotvec(fit[:, 0, 3:]), base[t])
    return out, fits, flies


def _flights(
    flies: np.ndarray, seen: np.ndarray, p: np.ndarray, dt: float, gravity: np.ndarray, most: float
) -> list[tuple[int, int]]:
    """First and last (exclusive) frames of the longest stretches that a parabola fits to within `most` everywhere."""
    found, a, rows = [], 0, np.flatnonzero(flies & seen)
    while a + LEAST <= len(rows):
        b = a + LEAST
        while b <= len(rows) and (b == a + LEAST or rows[b - 1] - rows[b - 2] <= NEAR):
            some = rows[a:b]
            if _parabola(some, p[some], dt, gravity, some)[1] > most:
                break
            b += 1
        if b - 1 - a >= LEAST and rows[b - 2] - rows[a] < 2 * (b - 1 - a):
            found.append((int(rows[a]), int(rows[b - 2]) + 1))
            a = b - 1
        else:
            a += 1
    return found


def _parabola(
    rows: np.ndarray, p: np.ndarray, dt: float, gravity: np.ndarray, at: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], float]:
    """Positions and velocities at frames `at` of a flight through p [K, 3] at frames `rows`, and the largest deviation
    from it."""
    time, later = (dt * (f - at[0])[:, None] for f in (rows, at))
    even = np.concatenate([np.ones_like(time), time], 1)
    level = p - 0.5 * time**2 * gravity
    fit = np.linalg.lstsq(even, level, rcond=None)[0]
    off = float(np.linalg.norm(level - even @ fit, axis=1).max())
    return (fit[0] + later * fit[1] + 0.5 * later**2 * gravity, fit[1] + later * gravity), off


def _rotations(done: list[Recording], flights: list[tuple], inertia: np.ndarray) -> None:
    """Write the torque-free rotations that fit flights best, by Gauss-Newton, all at once."""
    if not flights:
        return
    longest = max(b - a for _, _, a, b, *_ in flights)
    own = np.repeat(inertia[[d for _, d, *_ in flights]], 7, axis=0)
    steps = np.array([done[k].dt for k, *_ in flights])
    start = np.array([done[k].orientation[a, d] for k, d, a, *_ in flights])
    rate = np.array([w for *_, w in flights])
    nudge = np.zeros((7, 6))
    nudge[1:, :] = 1e-4 * np.eye(6)
    for turn in range(ROUNDS + 1):
        scale = np.concatenate([np.ones((len(steps), 3)), np.repeat(1.0 / (longest * steps)[:, None], 3, 1)], 1)
        moved = nudge[None] * scale[:, None]
        q = pose.multiply(pose.from_rotvec(moved[..., :3]), start[:, None]).reshape(-1, 4)
        w = (rate[:, None] + moved[..., 3:]).reshape(-1, 3)
        paths = [(q, w)]
        for _ in range(longest - 1):  # one step of each flight's own length, as inertia and time scale together
            q, spin = torque_free(q, w * np.repeat(steps, 7)[:, None], own, 1.0)
            w = spin / np.repeat(steps, 7)[:, None]
            paths.append((q, w))
        at, speed = (np.stack([p[i] for p in paths]).reshape(longest, len(steps), 7, -1) for i in range(2))
        for f, (k, d, a, b, rows, _) in enumerate(flights):
            if turn == ROUNDS:
                off = pose.to_rotvec(pose.multiply(done[k].goal[1][rows, d], pose.conjugate(at[rows - a, f, 0])))
                if np.linalg.norm(off, axis=1).max() > max(BEYOND * done[k].noise[1], 2.0 * ROUGH):
                    done[k].known[a:b] = done[k].flying[a:b, d] = False  # something turned it
                    continue
                done[k].orientation[a:b, d], done[k].angular_velocity[a:b, d] = at[: b - a, f, 0], speed[: b - a, f, 0]
                continue
            seen = done[k].goal[1][rows, d]
            off = pose.to_rotvec(pose.multiply(seen[:, None], pose.conjugate(at[rows - a, f]))).swapaxes(1, 2)
            slope = (off[..., 1:] - off[..., :1]) / 1e-4
            change = np.linalg.lstsq(slope.reshape(-1, 6), -off[..., 0].reshape(-1), rcond=None)[0]
            start[f] = pose.multiply(pose.from_rotvec(change[:3]), start[f])
            rate[f] = rate[f] + change[3:] * scale[f, 3:]


# --- poses and velocities that joints allow, near the observed ones ---


def jointed(scene: Scene) -> list[bool]:
    """For each moving body, whether a joint holds it, so that it does not fly freely."""
    rows = {k for joint in scene.joints for k in joint.bodies}
    return [k in rows for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]


def held_together(seen: Arrays, scene: Scene) -> Arrays:
    """Poses and velocities [T, D, *] of the moving bodies, corrected so that the joints of trees allow them: each is as
    observed relative to its parent, except for motion that the joint does not allow. Loops and distances are
    ignored."""
    tree = trees(scene)
    number = {k: d for d, k in enumerate(k for k, b in enumerate(scene.bodies) if b.motion == "dynamic")}
    arrays = [array.copy() for array in seen]
    count = len(arrays[0])

    def of(k: int) -> Arrays:
        if k in number:
            return tuple(array[:, number[k]] for array in arrays)  # type: ignore[return-value]
        body = scene.bodies[k] if k >= 0 else None
        place = np.zeros(3) if body is None else body.position + pose.rotate(body.quat_xyzw, _com(scene, k))
        turn = np.array([0.0, 0.0, 0.0, 1.0]) if body is None else body.quat_xyzw
        rest = np.zeros((count, 3))
        return np.tile(place, (count, 1)), np.tile(turn, (count, 1)), rest, rest

    for k in tree.order:
        if k in tree.above and k in number:
            one = tree.above[k]
            com_of_parent = np.zeros(3) if one.parent < 0 else _com(scene, one.parent)
            made = _allowed(one, of(k), of(one.parent), _com(scene, k), com_of_parent)
            for array, values in zip(arrays, made, strict=True):
                array[:, number[k]] = values
    place, turn, speed, spin = arrays
    return place, turn, speed, spin


def _com(scene: Scene, k: int) -> np.ndarray:
    return scene.bodies[k].scale * scene.shapes[scene.bodies[k].shape].com


def _allowed(one: Held, child: Arrays, parent: Arrays, com: np.ndarray, com_of_parent: np.ndarray) -> Arrays:
    """Pose and velocities of a child that its joint with the parent allows."""
    (place, turn, speed, spin), (base, lie, carried, turned) = child, parent
    own, theirs = one.frame.as_quat(), one.parent_frame.as_quat()
    frame = pose.multiply(lie, np.tile(theirs, (len(lie), 1)))
    axis = pose.rotate(frame, np.array([1.0, 0.0, 0.0]))
    kind = one.joint.kind
    seen = pose.multiply(pose.conjugate(frame), pose.multiply(turn, np.tile(own, (len(turn), 1))))
    twist = np.zeros_like(seen)
    twist[:, 3] = 1.0
    if kind == "hinge":
        twist = pose.normalise(seen * np.array([1.0, 0.0, 0.0, 1.0]))
    elif kind == "ball":
        twist = seen
    orientation = pose.multiply(pose.multiply(frame, twist), np.tile(pose.conjugate(own), (len(turn), 1)))
    relative = spin - turned
    if kind == "hinge":
        relative = axis * (relative * axis).sum(-1, keepdims=True)
    elif kind != "ball":
        relative = np.zeros_like(relative)
    rate = turned + relative
    arm = pose.rotate(lie, np.tile(one.parent_anchor - com_of_parent, (len(lie), 1)))
    anchor = base + arm
    # From the child's anchor to its centre of mass, as observed and as corrected.
    was, lever = (pose.rotate(q, np.tile(com - one.anchor, (len(q), 1))) for q in (turn, orientation))
    along, sliding = np.zeros_like(anchor), np.zeros_like(anchor)
    if kind == "slider":
        along = axis * ((place - was - anchor) * axis).sum(-1, keepdims=True)
        there = carried + np.cross(turned, arm + along)
        here = speed - np.cross(spin, was)
        sliding = axis * ((here - there) * axis).sum(-1, keepdims=True)
    velocity = carried + np.cross(turned, arm + along) + sliding + np.cross(rate, lever)
    return anchor + along + lever, orientation, velocity, rate


# --- flights of bodies that joints hold together ---


@dataclass(frozen=True)
class Swing:
    """A flight of D bodies that joints hold together, as observed in N frames."""

    time: np.ndarray  # [N] s, since its first frame
    position: np.ndarray  # [N, D, 3] m, of the centres of mass
    orientation: np.ndarray  # [N, D, 4]
    noise: tuple[float, float]  # m and rad


def flying_trees(scene: Scene) -> list[list[int]]:
    """Groups of moving bodies (by their numbers among these) that joints hold together and nothing else holds. Groups
    with loops or distances are left out."""
    if scene.effects.joints == "off":
        return []
    tree = trees(scene)
    number = {k: d for d, k in enumerate(k for k, b in enumerate(scene.bodies) if b.motion == "dynamic")}
    looped = {tree.root(k) for joint in tree.loops for k in joint.bodies}
    found: dict[int, list[int]] = {}
    for k in number:
        found.setdefault(tree.root(k), []).append(number[k])
    return [rows for root, rows in found.items() if root in number and len(rows) > 1 and root not in looped]


def tree_of(scene: Scene, rows: Sequence[int]) -> Scene:
    """A scene with only these moving bodies and their joints, without gravity."""
    moving = [k for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]
    new = {moving[row]: at for at, row in enumerate(rows)}
    joints = [j for j in scene.joints if set(j.bodies) <= set(new)]
    return replace(
        scene, bodies=tuple(scene.bodies[k] for k in new), gravity=np.zeros(3),
        joints=tuple(replace(j, bodies=(new[j.bodies[0]], new[j.bodies[1]])) for j in joints), frames=(), couplings=(),
    )  # fmt: skip


def swung(swings: Sequence[Swing], dt: float, scene: Scene) -> list[tuple[Arrays, float, float]]:
    """The motions of the tree `scene` in free flight that are nearest to the observed ones, frame by frame at `dt` s up
    to the last frame of each; and the root mean square errors of poses, m and rad. Positions and velocities are
    relative to the common centre of mass, which flies separately."""
    mass = np.array([b.mass for b in scene.bodies])
    share = mass / mass.sum()
    count, many = len(swings), len(mass)
    last = [round(float(s.time[-1]) / dt) for s in swings]
    guess = [np.stack(arrays) for arrays in zip(*(_begun(s, share) for s in swings), strict=True)]
    # Each body is rotated and spun, and moved where a joint lets it slide; joints remove what they do not allow.
    slides = [b for j in scene.joints if j.kind == "slider" for b in j.bodies]
    ways = [(array, d, c) for array, rows in ((1, range(many)), (3, range(many)), (0, slides), (2, slides))
            for d in rows for c in range(3)]  # fmt: skip
    length = scene_units(scene).length
    for turn in range(SWINGS + 1):
        tried = [np.repeat(array[:, None], 1 + len(ways), 1) for array in guess]
        # Rates are changed by enough to show at the end.
        step = np.empty((count, len(ways)))
        for w, (array, d, c) in enumerate(ways):
            step[:, w] = 1e-4 * (length if array in (0, 2) else 1.0)
            step[:, w] /= np.array(last) * dt if array in (2, 3) else 1.0
            _nudge(tried, slice(None), 1 + w, (array, d, c), step[:, w])
        flat = [array.reshape(-1, *array.shape[2:]) for array in tried]
        begun = tuple(array.reshape(count, 1 + len(ways), *array.shape[1:]) for array in _centred(flat, scene, share))
        if turn == SWINGS:
            begun = tuple(array[:, :1] for array in begun)
        paths = _flown(begun, dt, max(last), scene)
        if turn == SWINGS:
            break
        for f, swing in enumerate(swings):
            off = _off(swing, [path[f] for path in paths], dt, share).reshape(1 + len(ways), -1)
            slope = off[1:] - off[0]  # per step each, which makes rotations and rates comparable
            usual = max(1.0, 1.48 * float(np.median(np.abs(off[0]))))  # trackers are less exact in motion than at rest
            weight = (1.0 + np.square(off[0] / (SLACK * usual))) ** -0.25
            change = np.linalg.lstsq((slope * weight).T, -off[0] * weight, rcond=SINGULAR)[0]
            for w, way in enumerate(ways):
                _nudge(guess, f, None, way, change[w] * step[f, w])
    found = []
    for f, swing in enumerate(swings):
        own = cast("Arrays", tuple(path[f, 0, : last[f] + 1] for path in paths))
        off = _off(swing, [path[f] for path in paths], dt, share).reshape(-1, many, 6) * np.repeat(swing.noise, 3)
        away = [float(np.sqrt(np.square(off[..., k]).sum(-1).mean())) for k in (slice(0, 3), slice(3, 6))]
        found.append((own, away[0], away[1]))
    return found


def _nudge(arrays: list[np.ndarray], flight: int | slice, at: int | None, way: tuple[int, int, int], by) -> None:
    """Change a number of a body in flights; an orientation, by a rotation about a world axis."""
    array, d, c = way
    rows = arrays[array][flight] if at is None else arrays[array][flight, at]
    if array == 1:
        turn = np.zeros((*np.shape(by), 3))
        turn[..., c] = by
        rows[..., d, :] = pose.multiply(pose.from_rotvec(turn), rows[..., d, :])
    else:
        rows[..., d, c] += by


def _begun(swing: Swing, share: np.ndarray) -> Arrays:
    """[D, *] a first guess of a flight's start, by parabolas through its first frames, for positions about the centre
    of mass and for rotations."""
    time = swing.time[:BEGIN, None]
    powers = time ** np.arange(3)
    about = swing.position - (share[:, None] * swing.position).sum(1, keepdims=True)
    place = np.linalg.lstsq(powers, about[:BEGIN].reshape(len(time), -1), rcond=None)[0].reshape(3, -1, 3)
    first = swing.orientation[0]
    turned = pose.to_rotvec(pose.multiply(swing.orientation[:BEGIN], pose.conjugate(first)[None]))
    turn = np.linalg.lstsq(powers, turned.reshape(len(time), -1), rcond=None)[0].reshape(3, -1, 3)
    return place[0], pose.multiply(pose.from_rotvec(turn[0]), first), place[1], turn[1]


def _centred(arrays: Sequence[np.ndarray], scene: Scene, share: np.ndarray) -> Arrays:
    """Poses and velocities that joints allow, with the common centre of mass at rest at zero."""
    place, turn, speed, spin = held_together(cast("Arrays", tuple(arrays)), scene)
    about, drift = ((share[:, None] * array).sum(1, keepdims=True) for array in (place, speed))
    return place - about, turn, speed - drift, spin


def _flown(begun: tuple[np.ndarray, ...], dt: float, frames: int, scene: Scene) -> list[np.ndarray]:
    """[F, P, T, D, *] poses and velocities of flights from their starts [F, P, D, *], which come first."""
    count, many = begun[0].shape[0] * begun[0].shape[1], len(scene.bodies)
    copies = Copies(scene, count)
    u, solver, step = copies.units, copies.solver, dt / copies.units.time
    state = copies.begun(*(array.reshape(count * many, -1) for array in begun))
    options = Options(np.zeros(3), step, inner_of_frame(step))
    moved = cast("Frames", solver.advance(state, solver.init(copies.bodies, state, options), frames, keep=True).frames)
    kept = (moved.position * u.length, moved.orientation, moved.velocity * u.velocity, moved.angular_velocity / u.time)
    paths = []
    for first, later in zip(begun, kept, strict=True):
        later = np.moveaxis(later.reshape(frames, *first.shape), 0, 2)
        paths.append(np.concatenate([first[:, :, None], later], 2))
    return paths


def _off(swing: Swing, paths: Sequence[np.ndarray], dt: float, share: np.ndarray) -> np.ndarray:
    """[P, N, D, 6] for paths [P, T, D, *]: differences from the observed poses, relative to the centre of mass, in
    standard deviations."""
    rows = np.round(swing.time / dt).astype(int)
    about = swing.position - (share[:, None] * swing.position).sum(1, keepdims=True)
    away = pose.to_rotvec(pose.multiply(paths[1][:, rows], pose.conjugate(swing.orientation)[None]))
    return np.concatenate([(paths[0][:, rows] - about) / swing.noise[0], away / swing.noise[1]], -1)
