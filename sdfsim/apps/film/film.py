"""From a film and a scene to a recording: the whole way, and what goes wrong on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sdfsim.apps.film.background import background, checked
from sdfsim.apps.film.beside import write_beside
from sdfsim.apps.film.camera import BY_FALLING, in_world, level, of_ball, of_points, read_points
from sdfsim.apps.film.drawing import Look
from sdfsim.apps.film.eye import Eye
from sdfsim.apps.film.frames import Clip, read_clip
from sdfsim.apps.film.recording import recording_of
from sdfsim.apps.film.room import of_room, photos_of
from sdfsim.apps.film.supports import behind_others, supported, with_paths
from sdfsim.apps.film.track import (
    Film,
    Shutter,
    Track,
    again,
    deepened,
    either,
    find,
    follow,
    lies,
    masks,
    shutter_of,
    without_others,
)
from sdfsim.apps.identify.filmed import Filmed, identify_films
from sdfsim.apps.identify.report import Identified
from sdfsim.apps.observed import Recording, movers
from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.base.parallel import Progress, silent
from sdfsim.physics import pose
from sdfsim.scene.builder import SceneBuilder, loaded
from sdfsim.scene.scene import Body, Scene, Waypoints

FITS = 0.6  # score that most frames of a body of the right shape have
ENOUGH = 8  # frames in which a body must be seen
AGAIN = 3  # more rounds of the fit
SETTLED = 0.01  # rad, share of the distance, and of the focal length: changes of the camera that end them
WORSE = 1.2  # rise of the cost of a round that ended elsewhere
GONE = 0.25  # share of the frames after which a body may be out of the picture


def track(
    clip: Path | str, scene: Scene | SceneBuilder | Path | str, *, points: Path | str | None = None, slow: float = 1.0,
    start: float | None = None, end: float | None = None, bodies: Sequence[str] = (), on_progress: Progress = silent,
) -> Recording:  # fmt: skip
    """Where the moving bodies of a scene were in a film of a fixed camera, with an uncertainty of each pose.

    The camera is found from `points` of known places (a YAML file, see docs/identify.md), from the photos of a scene
    that `sdfsim reconstruct` made, or from a single ball that bounces on level ground. `slow`: how many times slower
    the film plays than things moved; `start` and `end` s: the part of the film; `bodies`: names of those that move in
    it (all moving bodies of the scene if none of these is named), and of static ones that are moved along, as a plank
    that is tilted. Raises SdfsimError for films in which the bodies cannot be tracked.
    """
    return watched(
        Path(clip), loaded(scene), points=points, slow=slow, start=start, end=end, bodies=bodies,
        on_progress=on_progress,
    ).recording  # fmt: skip


def watched(
    path: Path, scene: Scene, *, points: Path | str | None = None, slow: float = 1.0, start: float | None = None,
    end: float | None = None, bodies: Sequence[str] = (), on_progress: Progress = silent,
) -> Film:  # fmt: skip
    """As `track`, with everything else that was found."""
    names, given, scene = bodies, scene, with_moving(scene, bodies)
    clip = read_clip(path, slow=slow, start=start, end=end, on_progress=on_progress)
    back = background(clip)
    checked(clip, back)
    moving, size = movers(scene), (clip.pixels.shape[2], clip.pixels.shape[1])
    looks = [Look(scene, body) for body in moving]
    led = [body for body in scene.bodies if body.motion == "kinematic" and body.name in names]
    room = photos_of(scene.path)
    if points is not None:
        eye = of_points(read_points(Path(points)).smaller(clip.smaller), size, str(points))
    elif room is not None:
        still = np.median(clip.pixels[:: max(1, len(clip.time) // 15)], 0).astype(np.uint8)
        eye = of_points(of_room(still, room, str(path)), size, f"the photos of {room}")
    elif len(looks) == 1 and looks[0].ball and not led:
        eye = level(clip)
    else:
        raise SdfsimError(
            f"{path}: where the camera stood is not known (a single ball shows it, and photos of a room do)",
            "give points of known places: --points points.yaml (docs/identify.md)",
        )
    shutter, tracks, gravity = Shutter(0.5 * clip.step, 0.7), [], np.asarray(scene.gravity)
    supports = supported(clip, back, eye, [Look(scene, body) for body in led], led, shutter, on_progress)
    if supports:
        supports, back = behind_others(clip, eye, supports, shutter)

    def whole(body: Body, look: Look) -> Track:
        place = body.position + pose.rotate(body.quat_xyzw, look.com)
        k, one = find(clip, back, look, eye, place, body.quat_xyzw, body.name, on_progress, free=len(moving) == 1)
        track = follow(clip, back, look, eye, shutter, k, one, gravity, on_progress=on_progress)
        _judged(clip, track, body.name)
        return track

    for body, look in zip(moving, looks, strict=True):
        try:
            lying = look.lying(scene, body)
            tracks.append(whole(body, lying or look))
        except SdfsimError:
            if lying is None:
                raise
            tracks.append(whole(body, look))
    shutter = shutter_of(clip, back, eye, tracks[0])
    covered = [masks(clip, eye, one) for one in tracks]
    every = [either([of[k] for of in covered]) for k in range(len(clip.time))]
    if supports:
        supports, back = behind_others(clip, eye, supports, shutter, every)
    else:
        back = background(clip, every)

    def refined(track: Track, others: list[np.ndarray | None]) -> Track:
        k = max(track.frames.tolist(), key=lambda k: track.at(k).score)
        full = follow(clip, back, track.look, eye, shutter, k, track.at(k), gravity, others, on_progress)
        return without_others(clip, eye, again(clip, back, eye, shutter, full, others))

    for d, (body, look) in enumerate(zip(moving, looks, strict=True)):
        others = [either([of[k] for j, of in enumerate(covered) if j != d]) for k in range(len(clip.time))]
        full = refined(tracks[d], others)
        if full.look is not look:
            free = again(clip, back, eye, shutter, Track(look, full.seen), others)
            full = free if lies(clip, full, free) else refined(whole(body, look), others)
        tracks[d] = deepened(clip, eye, full)
    for body, one in zip([*led, *moving], [*supports, *tracks], strict=True):
        _judged(clip, one, body.name)
    for body, one in zip(moving, tracks, strict=True):
        _stays(clip, eye, one, body.name)
    if eye.source == BY_FALLING:
        look = looks[0]
        below = [
            b.position[2] + b.scale * given.shapes[b.shape].sdf.bounds[1, 2]
            for b in given.bodies
            if b.motion == "static"
        ]
        ground = max([z if np.isfinite(z) else 0.0 for z in below], default=0.0) + look.ball
        eye, turn, shift = of_ball(clip, eye, tracks[0].seen, np.asarray(scene.gravity), moving[0].position, ground)
        moved = [one and in_world(one, turn, shift) for one in tracks[0].seen]
        tracks = [deepened(clip, eye, again(clip, back, eye, shutter, Track(look, moved)))]
    notes = [*clip.notes, f"shutter open for {1e3 * shutter.open:.2g} ms, smeared by {shutter.spread:.2g} px"]
    scene = with_paths(clip, eye, scene, supports)
    return Film(clip, back, shutter, eye, tracks, supports, scene, recording_of(clip, eye, tracks, scene), notes)


def identify_clips(
    paths: Sequence[Path], scene: Scene, *, points: Path | None = None, slow: float = 1.0, start: float | None = None,
    end: float | None = None, bodies: Sequence[str] = (), beside: Path | None = None, on_progress: Progress = silent,
) -> Identified:  # fmt: skip
    """Parameters of a scene from films of it, see `track`; with `beside`, a movie of the first film with the outlines
    of the fit's motion. Raises SdfsimError also for several films of a support that is moved."""
    films = [
        watched(path, scene, points=points, slow=slow, start=start, end=end, bodies=bodies, on_progress=on_progress)
        for path in paths
    ]
    films, fit = settled(films, on_progress)
    if beside is not None:
        first, motion = films[0], fit.motion()
        row = np.round((first.clip.time - first.clip.time[0]) / first.recording.dt).astype(int)

        def made(k: int, d: int) -> tuple[np.ndarray, np.ndarray] | None:
            now = motion.get((0, int(row[k])))
            return now and (now[0][d], now[1][d])

        write_beside(first, made, beside)
    notes = [f"{film.clip.path.name}: {note}" for film in films for note in film.notes]
    found = fit.shown()
    return replace(found, notes=[*found.notes, *notes])


def settled(films: list[Film], on_progress: Progress = silent) -> tuple[list[Film], Filmed]:
    """What films show, and the films with their cameras as the motion shows them. Raises SdfsimError for several films
    of a support that is moved."""
    if len(films) > 1 and films[0].supports:
        raise SdfsimError("a support moves in its own way in each film", "identify from one film at a time")
    fit = identify_films([film.recording for film in films], films[0].scene, on_progress=on_progress)
    moved = np.zeros(len(fit.fit.camera))
    for _ in range(AGAIN):  # the camera as the motion shows it; its effect is only linear nearby
        ends = np.cumsum([film.eye.doubt.shape[1] for film in films])[:-1]
        changes = [f.eye.doubt @ by for f, by in zip(films, np.split(fit.fit.camera, ends), strict=True)]
        if all(_small(film, change) for film, change in zip(films, changes, strict=True)):
            break
        moved = moved + fit.fit.camera
        other = [_seen_by(film, film.eye.moved(change)) for film, change in zip(films, changes, strict=True)]
        records = [film.recording for film in other]
        closer = identify_films(records, other[0].scene, near=fit, moved=moved, on_progress=on_progress)
        if closer.fit.cost > WORSE * fit.fit.cost:
            break
        films, fit = other, closer
    return films, fit


def _small(film: Film, change: np.ndarray) -> bool:
    """Whether a change [WAYS] of a film's camera is so small that its effect is linear."""
    track = film.tracks[0]
    away = float(film.eye.seen(track.at(int(track.frames[0])).place)[2])
    return bool((np.abs(change) < SETTLED * np.r_[np.ones(3), np.full(3, away), 1.0]).all())


def _seen_by(film: Film, eye: Eye) -> Film:
    """The film with another camera: the same pictures, and so bodies where they then have to be."""
    placed, was = [], film.eye
    for one in (*film.tracks, *film.supports):
        seen = list(one.seen)
        for k in one.frames.tolist():
            local = was.seen(seen[k].place) * (eye.focal / was.focal)
            local[:2] *= was.focal / eye.focal
            seen[k] = replace(seen[k], place=(local - eye.translation) @ eye.rotation)
        placed.append(Track(one.look, seen))
    tracks, supports, back, scene = placed[: len(film.tracks)], placed[len(film.tracks) :], film.back, film.scene
    if supports:
        covered = [masks(film.clip, eye, one) for one in tracks]
        every = [either([of[k] for of in covered]) for k in range(len(film.clip.time))]
        supports, back = behind_others(film.clip, eye, supports, film.shutter, every)
        scene = with_paths(film.clip, eye, scene, supports)
    tracks = [deepened(film.clip, eye, again(film.clip, back, eye, film.shutter, one)) for one in tracks]
    recording = recording_of(film.clip, eye, tracks, scene)
    return replace(film, back=back, eye=eye, tracks=tracks, supports=supports, scene=scene, recording=recording)


def with_moving(scene: Scene, names: Sequence[str]) -> Scene:
    """The scene in which only these of the moving bodies move (all if none of them is named), and static ones of these
    names are bodies on paths. Raises SdfsimError for a name that it does not have."""
    known = {body.name: body.motion for body in scene.bodies if np.isfinite(scene.shapes[body.shape].sdf.bounds).all()}
    for name in names:
        if name not in known:
            raise SdfsimError(
                f"--body {name}: no body of the scene{nearest(name, list(known))}", f"it has {', '.join(known)}"
            )
    chosen = any(known[name] == "dynamic" for name in names)
    bodies = []
    for body in scene.bodies:
        if body.name in names and body.motion == "static":
            path = Waypoints(np.zeros(1), body.position[None], body.quat_xyzw[None])
            bodies.append(replace(body, motion="kinematic", path=path))
        elif chosen and body.motion == "dynamic" and body.name not in names:
            bodies.append(replace(body, motion="static", velocity=np.zeros(3), angular_velocity=np.zeros(3)))
        else:
            bodies.append(body)
    return replace(scene, bodies=tuple(bodies)) if names else scene


def _judged(clip: Clip, track: Track, name: str) -> None:
    """Raises SdfsimError if a body was seen too seldom, or does not look as in the scene."""
    rows = track.frames
    if len(rows) < ENOUGH:
        hint = "more light, a plainer background, or more frames a second; --start and --end choose a part"
        raise SdfsimError(f"{clip.path}: {name!r} was found in {len(rows)} frames (at least {ENOUGH})", hint)
    score = float(np.median([track.at(k).score for k in rows]))
    if score < FITS:
        hint = "check its shape and size in the scene, and the camera"
        raise SdfsimError(f"{clip.path}: what moves does not look like {name!r} (fits by {100 * score:.0f} %)", hint)


def _stays(clip: Clip, eye: Eye, track: Track, name: str) -> None:
    """Raises SdfsimError if a body leaves the picture long before the film ends."""
    last = int(track.frames[-1])
    one, count = track.at(last), len(clip.time)
    at = track.look.window(eye, one.place, one.turn, 0.0)
    before = track.at(int(track.frames[-2]))
    way = eye.project(one.place) - eye.project(before.place)
    near = (
        at is None
        or (np.array([at.left, at.top, eye.width - at.right, eye.height - at.bottom]) < 3 + np.abs(way).max()).any()
    )
    if near and count - 1 - last > max(2, GONE * count):
        when = clip.time[last]
        raise SdfsimError(
            f"{clip.path}: {name!r} leaves the picture after {when:.2f} s", f"end there: --end {when:.2f}"
        )
