"""The uncertainty of each place of a surface, and the photos that would help most.

A photo fixes a point across its line of sight, to about a pixel, and not at all along it. Lines of sight from several
directions together fix it. Surface that fewer than two photos see is a guess of the field.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from pipeline.cameras import View, focus
from pipeline.mesh.visibility import FAIR, Visibility, framed
from pipeline.records import Proposal, Trust
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, face_normals, joined

FEW = 3  # photos: surface that fewer see is weak
PARALLEL = 1e-12  # of lines of sight: least determinant of their information, with its trace as unit
# Colours from the most to the least certain place (anchors of viridis), and of guessed surface.
SCALE = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], float)
GUESSED = np.array([255.0, 45, 45])
WANTED = 3  # photos that are proposed
SAMPLES = 6000  # of the surface
PLACES = 600  # directions around the scene in which cameras are tried
HIGHER = 30.0  # degrees by which these may be above or below the cameras given; and the lowest and highest
LOWEST, HIGHEST = -60.0, 80.0
UNSURE = 3.0  # times the median uncertainty: beyond this a place is weak however many photos see it
CLEAR = 0.1  # times the cameras' distance: least distance of a camera from any surface and from the floor
SHARED = 0.2  # share of a photo's view that is already well known: with less it cannot be matched with the others
APART = 15.0  # degrees between the photos proposed
LEAST = 0.01  # share of the surface that a photo has to improve to be worth taking
# Degrees up to which a move is described in metres; share of the distance that is not mentioned.
NEARBY, SLIGHT = (35.0, 0.04)


@dataclass(frozen=True)
class Evidence:
    """The photos' information on the positions of some points."""

    vertices: np.ndarray  # [V, 3] m, the points
    normals: np.ndarray  # [V, 3] unit, of the surface there
    views: np.ndarray  # [V] int, number of photos that see each
    information: np.ndarray  # [V, 3, 3] 1/m^2, see `information`; summed over these photos

    @property
    def uncertainty(self) -> np.ndarray:
        """[V] m, see `sigma_along`; infinite: guessed, as fewer than two photos see the point."""
        return np.where(self.views > 1, sigma_along(self.information, self.normals), np.inf)

    def at(self, index: np.ndarray) -> "Evidence":
        """The same for some of the points."""
        return Evidence(self.vertices[index], self.normals[index], self.views[index], self.information[index])

    def nearest(self, points: np.ndarray) -> "Evidence":
        """That of the nearest vertex to each of other points [P, 3] m."""
        return self.at(np.asarray(KDTree(self.vertices).query(points)[1]))

    def attributes(self) -> dict[str, np.ndarray]:
        """Its attributes in a mesh file: `views` [V] int32 and `uncertainty` [V] float32 m."""
        return {"views": self.views.astype(np.int32), "uncertainty": self.uncertainty.astype(np.float32)}


def information(view: View, points: np.ndarray) -> np.ndarray:
    """The information of one photo on points [P, 3] in front of it: the inverse [P, 3, 3] of the covariance of the
    position, in 1 / (unit of the points)^2, of rank two.

    The photo is assumed to have an error of 1 px (standard deviation) on both axes, and an exact camera: J^T J of the
    projection's Jacobian J (Hartley and Zisserman, Multiple View Geometry, 5.2). Lens distortion is left out.
    """
    local = points @ view.rotation.T + view.translation
    depth = local[:, 2, None, None]
    rows = view.focal / depth * (view.rotation[:2] - local[:, :2, None] / depth * view.rotation[2])
    return np.einsum("pki,pkj->pij", rows, rows)


def sigma_along(information: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Standard deviation [P] of places along unit directions [P, 3], from information [P, 3, 3]; else infinite."""
    a, b, c = np.moveaxis(information, 1, 0)
    crossed = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)  # the inverse, times the determinant
    size = np.einsum("pi,pi->p", a, crossed[:, 0])
    known = size > PARALLEL * np.trace(information, axis1=1, axis2=2) ** 3
    variance = np.einsum("pi,pij,pj->p", normals, crossed, normals) / np.where(known, size, 1.0)
    return np.where(known, np.sqrt(np.maximum(variance, 0)), np.inf)


def evidence_of(sight: Visibility, views: Sequence[View]) -> Evidence:
    """The views' information on the vertices of a mesh, all in metres."""
    count = len(sight.vertices)
    seen, total = np.zeros(count, np.int64), np.zeros((count, 3, 3))
    for view in views:
        index = sight.of_view(view)[0]
        seen[index] += 1
        total[index] += information(view, sight.vertices[index])
    return Evidence(sight.vertices, sight.normals, seen, total)


def vertex_areas(mesh: Mesh) -> np.ndarray:
    """Area [V] m^2 of each vertex: a third of its faces' area."""
    area = np.repeat(face_normals(mesh)[1] / 3, 3)
    return np.bincount(mesh.faces.ravel(), area, minlength=len(mesh.vertices))


def summary(mesh: Mesh, evidence: Evidence) -> Trust:
    """What photos show of a mesh."""
    area, uncertainty = vertex_areas(mesh), evidence.uncertainty
    known = np.isfinite(uncertainty)
    median = None
    if known.any():
        median = float(np.quantile(uncertainty[known], 0.5, weights=area[known], method="inverted_cdf"))
    seen_by = np.bincount(np.minimum(evidence.views, FEW), area, minlength=FEW + 1) / area.sum()
    return Trust(seen_by.round(4).tolist(), round(float(area[~known].sum() / area.sum()), 4), median)


def color_range(mesh: Mesh, uncertainty: np.ndarray) -> tuple[float, float]:
    """Uncertainties (m) of the first and the last colour: between them lie nine tenths of the known area."""
    known = np.isfinite(uncertainty)
    if not known.any():
        return 1e-3, 1e-2
    areas = vertex_areas(mesh)[known]
    low, high = np.quantile(uncertainty[known], [0.05, 0.95], weights=areas, method="inverted_cdf").tolist()
    return low, max(high, 1.01 * low)


def colors_of(uncertainty: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Colours [V, 3] in 0..255 for uncertainties [V] m: violet is most certain, yellow least certain, red is
    guessed."""
    known = np.isfinite(uncertainty)
    position = np.log(np.where(known, uncertainty, 1.0) / limits[0]) / np.log(limits[1] / limits[0])
    place = np.clip(position, 0, 1) * (len(SCALE) - 1)
    color = np.stack([np.interp(place, np.arange(len(SCALE)), channel) for channel in SCALE.T], -1)
    return np.where(known[:, None], color, GUESSED)


def next_photos(
    meshes: Mapping[str, Mesh], evidence: Evidence, sight: Visibility, solid: Caster, views: Sequence[View],
    counted: np.ndarray,
) -> tuple[list[Proposal], list[View], float]:  # fmt: skip
    """The photos that help most and their cameras, the best first, chosen greedily; empty if none improves `LEAST` of
    the surface. Also the weak share of the surface that the photos or a camera around the scene could show.

    Surface is weak if fewer than `FEW` photos see it, or if it is `UNSURE`. A photo helps a place that it sees without
    occlusion and at a good angle: by the share of `FEW` photos that the place lacks, else by the reduction of
    uncertainty. Meshes are closed, by name, in metres with the floor at z = 0; only vertices that are `counted` [V]
    bool matter.
    """
    if not counted.any():
        return [], [], 0.0
    area = np.where(counted, vertex_areas(joined(list(meshes.values()))), 0)
    index = np.random.default_rng(0).choice(len(area), SAMPLES, p=area / area.sum())
    part = np.repeat(np.arange(len(meshes)), [len(mesh.vertices) for mesh in meshes.values()])[index]
    now, sight = evidence.at(index), sight.at(index)
    sure = now.uncertainty[np.isfinite(now.uncertainty)]
    limit = UNSURE * float(np.median(sure)) if len(sure) else 0.0
    middle, towards = focus(views, np.median(evidence.vertices[counted], axis=0))
    places = _places(views, middle, towards, solid)
    around = [sight.of_place(place, np.ones(SAMPLES, bool)) for place in places]
    around = [seen[cosine > FAIR] for seen, cosine in around]
    reachable = now.views > 0
    for seen in around:
        reachable[seen] = True
    total = max(int(reachable.sum()), 1)
    poor = (now.views < FEW) | (now.uncertainty > limit)
    weak = poor & reachable
    short = FEW - now.views[weak]
    lacking = float(np.where(short > 0, short * (short + 1) / (2 * FEW), 1.0).sum())  # largest sum of `worth`
    chosen: list[Proposal] = []
    cameras: list[View] = []
    free = np.ones(len(places), bool)
    while len(chosen) < WANTED:
        found = _best(now, poor, [(places[k], around[k]) for k in np.flatnonzero(free)], middle, views[0])
        if found is None or found[0] < LEAST * total:
            break
        gain, view, target, seen = found
        view = replace(view, name=f"next{len(chosen) + 1}", source=f"next{len(chosen) + 1}")
        counts, matrices = now.views.copy(), now.information.copy()
        counts[seen] += 1
        matrices[seen] += information(view, now.vertices[seen])
        now = replace(now, views=counts, information=matrices)
        poor = (counts < FEW) | (now.uncertainty > limit)
        most = int(np.bincount(part[seen]).argmax())
        words = f"{way_to(view.center, views, middle)}, looking at {list(meshes)[most]}"
        chosen.append(Proposal(view.center.tolist(), target.tolist(), gain / lacking, words))
        cameras.append(view)
        turned = (places - middle) @ (view.center - middle)
        turned /= np.linalg.norm(places - middle, axis=1) * np.linalg.norm(view.center - middle)
        free &= turned < np.cos(np.radians(APART))
    return chosen, cameras, float(weak.sum() / total)


def worth(now: Evidence, view: View, seen: np.ndarray) -> np.ndarray:
    """Gain of a photo for each of the places [S] that it sees, 0 to 1."""
    here = now.at(seen)
    after = sigma_along(here.information + information(view, here.vertices), here.normals)
    rest = np.divide(after, here.uncertainty, out=np.ones(len(seen)), where=np.isfinite(after))
    return np.where(here.views < FEW, (FEW - here.views) / FEW, 1 - np.minimum(rest, 1))


def _best(
    now: Evidence, poor: np.ndarray, tried: Sequence[tuple[np.ndarray, np.ndarray]], middle: np.ndarray, lens: View
) -> tuple[float, View, np.ndarray, np.ndarray] | None:
    """The photo that helps most: its gain, its camera, its target [3] m, and the places [S] that it helps.

    Samples are weak where `poor` [V] bool. `tried` are places [3] m with the samples [S] in sight, all around; a camera
    looks at the `middle` [3] m, or at the middle of the weak places in sight.
    """
    best = None
    for place, around in tried:
        helped = around[poor[around]]
        if not len(helped) or (best is not None and len(helped) <= best[0]):
            continue
        for target in (middle, now.vertices[helped].mean(0)):
            view = camera_at(place, target, lens)
            seen = around[framed(view, now.vertices[around])[1]]
            if not len(seen) or poor[seen].mean() > 1 - SHARED:
                continue
            seen = seen[poor[seen]]
            gains = worth(now, view, seen)
            if best is None or gains.sum() > best[0]:
                best = float(gains.sum()), view, target, seen[gains > 0]
    return best


def camera_at(place: np.ndarray, target: np.ndarray, like: View) -> View:
    """A camera at a place [3] that looks at a target [3], held level (z up), with the lens of a given camera."""
    forward = target - place
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return replace(like, rotation=rotation, translation=-rotation @ place)


def _places(views: Sequence[View], middle: np.ndarray, towards: np.ndarray, solid: Caster) -> np.ndarray:
    """Places [C, 3] where a camera could be: around the scene, at the median distance of the given ones, in free space
    and in sight of a given one."""
    given = np.array([view.center for view in views])
    far = float(np.median(np.linalg.norm(given - middle, axis=1)))
    height = np.degrees(np.arcsin(np.clip(-towards[:, 2], -1, 1)))
    low, high = np.sin(np.radians(np.clip([height.min() - HIGHER, height.max() + HIGHER], LOWEST, HIGHEST)))
    z = low + (high - low) * (np.arange(PLACES) + 0.5) / PLACES
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(PLACES)  # the golden angle spreads them evenly
    flat = np.sqrt(1 - z**2)
    places = middle + far * np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)
    places = places[(places[:, 2] > CLEAR * far) & (solid.clearance(places) > CLEAR * far)]
    if not len(places):
        return places
    starts, ends = np.repeat(places, len(given), axis=0), np.tile(given, (len(places), 1))
    in_sight = ~solid.blocked(starts, ends).reshape(len(places), len(given))
    return places[in_sight.any(1)]


def way_to(place: np.ndarray, views: Sequence[View], middle: np.ndarray) -> str:
    """The way to a place [3] from the place of the nearest photo, in words."""
    nearest = min(views, key=lambda view: float(np.linalg.norm(view.center - place)))
    right = nearest.rotation[0] * [1, 1, 0]
    right /= max(np.linalg.norm(right), 1e-12)
    forward = np.cross([0.0, 0.0, 1.0], right)
    step = place - nearest.center
    turns = [np.arctan2(*(at - middle)[1::-1]) for at in (nearest.center, place)]
    turn = (np.degrees(turns[1] - turns[0]) + 180) % 360 - 180
    ways = [(step[2], "higher", "lower")]
    around = ""
    if abs(turn) > NEARBY:
        around = f"walk {abs(turn):.0f}° around the scene to your {'right' if turn > 0 else 'left'} from there, "
    else:
        ways = [(step @ right, "to the right", "to the left"), (step @ forward, "forward", "back"), *ways]
    slight = SLIGHT * float(np.linalg.norm(place - middle))
    steps = [f"{abs(size):.2g} m {one if size > 0 else other}" for size, one, other in ways if abs(size) > slight]
    moved = around + (", ".join(steps) or ("at the same height" if around else "from the same place"))
    return f"stand where {nearest.source} was taken, {moved}"
