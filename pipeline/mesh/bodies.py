"""Finds bodies, which stand on a level plane or have masks, and closes the scenery where they stood.

Everything here is in normalised space; heights are measured along a plane's normal.
"""

import itertools
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from pipeline.cameras import PosedPhotos, frame_of
from pipeline.inputs.labels import load_labels, load_names
from pipeline.mesh.clicks import Scene, parts_by_clicks
from pipeline.mesh.extraction import (
    FLOATER,
    LIFT,
    RIM,
    Distance,
    FieldSurface,
    Volume,
    components,
    islands,
    keep_faces,
    marked,
    sample,
    sample_box,
)
from pipeline.mesh.photo_refining import load_grey_photos, refine
from pipeline.mesh.placement import LEVEL_NORMAL
from pipeline.mesh.seams import (
    ConnectedSolid,
    Part,
    Votes,
    count_votes,
    part_of_name,
    parts_by_shape,
    parts_by_votes,
    solid_of,
)
from pipeline.mesh.symmetry import Known
from pipeline.mesh.symmetry import complete as completed
from pipeline.mesh.trust import evidence_of
from pipeline.mesh.visibility import Visibility, look, spread_colors, to_bytes
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Caster, ClosestPoint
from sdfsim.geometry.mesh import Mesh, face_normals

# Shares, without unit, set by hand on the rendered sets (table with a vase, `touching`, `shelf`) together, unless one
# is named, or photos of a fox's head. No set was kept apart for testing them.
LEVEL_SHARE = 0.1  # of the largest level plane: smaller planes carry nothing; the lid of a box is not a table
SMALLEST_PLANE = 0.005  # of the visible surface: less is a flat place on something, such as fur (fox)
LARGEST_FOOT = 0.5  # largest share of its plane that a body covers; more is relief
CARRIED = 0.3  # share of a level plane above a component: from here on it carries the plane
SEEN_SHARE = 0.2  # of a body's surface, that photos have to show
FEW, SEEN_BY_FEW = 3, 0.05  # photos that have to show a body, and how much of its surface
STANDS = 0.3  # least share of a body's lowest layer that has the solid of the plane right below it
CRUMB = 0.05  # of a body's samples: a smaller piece next to it was separated by noise, and belongs to it
FLAKE = 0.02  # of the area of a body's largest piece: smaller pieces are left out
SCRAP = 0.4  # of the length of the first piece of a masked body: a shorter second piece is left out (touching, shelf)
# Noise has less than the first share of the largest body's surface, and less than the second share of the highest
# density of sparse points of any body: on `shelf` bodies had 0.34 to 0.45 points on a cell, noise 0 and 0.008.
SMALL_NOISE, BARE = 0.15, 0.05
# In cells of the field's finest grid, which limits what can be separated:
ON = 1.5  # depth of the samples below a plane that decide where it continues
LAYER = 1.5  # thickness of the contact layer, in which a field cannot separate a body from its support
SMALLEST = 4.0  # a lower piece stays part of its support
FINER = 1 / 3  # distance of a body's samples
ENOUGH = 96  # samples along a body's longest side, if the field is finer
FILLET = 3.0  # contact layers sideways: matter so near a body's foot is removed together with it
FEWEST_SAMPLES = 8  # of a component: fewer are not a body
NOWHERE = np.zeros((0, 3))  # no points


@dataclass(frozen=True)
class LevelPlane:
    """A level plane."""

    normal: np.ndarray  # [3] unit, upwards
    height: float  # of the plane along it
    area: float  # seen by photos

    def above(self, points: np.ndarray) -> np.ndarray:
        """Height [...] of points [..., 3] above the plane."""
        return points @ self.normal - self.height


@dataclass(frozen=True, eq=False)
class FoundBody:
    """A body that stands on a level plane, or that has masks."""

    name: str  # from its masks, else object1, object2 ... from the largest down
    level: LevelPlane  # its support, infinitely far below if unknown
    size: float  # the longest side of its bounding box
    # [X, Y, Z] bool on a part of the samples: those nearest to this body, among all bodies on the plane
    own: np.ndarray
    low: np.ndarray  # [3] position of the first of these samples
    cell: float  # between them
    layer: float  # thickness of the contact layer, in which the field cannot separate body and plane
    hollow: np.ndarray  # [A, B] bool on the plane: places enclosed by the body at the top of the contact layer
    corner: np.ndarray  # [2] of the first of these, in the axes of `frame_of` the plane
    seam: Volume | None = None  # border to bodies that it touches, negative within; None without such a border

    def part_of(self, volume: Volume) -> tuple[slice, ...]:
        """The samples of `own` among those of the whole volume."""
        start = np.round((self.low - volume.low) / volume.cell).astype(int)
        return tuple(slice(low, low + count) for low, count in zip(start, self.own.shape, strict=True))

    def lifted(self, points: np.ndarray) -> np.ndarray:
        """Points [P, 3], those below the top of the contact layer raised to it."""
        return points + np.maximum(self.layer - self.level.above(points), 0)[:, None] * self.level.normal

    def owns(self, points: np.ndarray) -> np.ndarray:
        """Whether points [P, 3] are nearer to this body than to anything else on the plane."""
        return marked(self.own, np.round((points - self.low) / self.cell).astype(int))

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Whether points [P, 3] are in the contact layer and enclosed by the body, like the floor of a cup."""
        index = np.round((points @ frame_of(self.level.normal)[:2].T - self.corner) / (0.5 * self.cell)).astype(int)
        return marked(self.hollow, index) & (self.level.above(points) < self.layer)

    def distance(self, field: Distance) -> Distance:
        """Its signed distance, from the field's: the cross-section above the contact layer continues down to the plane.
        The enclosed part, such as the floor of a cup, stays as in the field."""

        def value(points: np.ndarray) -> np.ndarray:
            lifted, holds = self.lifted(points), self.holds(points)
            found = field(np.where(holds[:, None], points, lifted))
            if self.seam is not None:
                found = np.maximum(found, self.seam.at(lifted))
            return np.maximum(np.where(self.owns(lifted) | holds, found, self.cell), -self.level.above(points))

        return value


def find_level_planes(shown: Mesh, up: np.ndarray, width: float, share: float = LEVEL_SHARE) -> list[LevelPlane]:
    """Level planes of a surface, largest first, down to a `share` of that one's area; `up` [3] is unit, and faces
    within `width` belong to one plane."""
    normals, areas = face_normals(shown)
    least = SMALLEST_PLANE * areas.sum()
    centers = shown.vertices[shown.faces].mean(1)
    flat = normals @ up > LEVEL_NORMAL
    normals, areas, centers = normals[flat], areas[flat], centers[flat]
    levels: list[LevelPlane] = []
    while len(areas):
        height = centers @ up
        bins = ((height - height.min()) / width).astype(int)
        total = np.bincount(bins, areas)
        # Must not miss a plane on the border of two bins.
        fullest = int(np.argmax(total + np.append(total[1:], 0)))
        member = (bins == fullest) | (bins == fullest + 1)
        if areas[member].sum() < max(least, share * levels[0].area if levels else 0.0):
            break
        middle = np.average(centers[member], axis=0, weights=areas[member])
        offset = centers[member] - middle
        normal = np.linalg.eigh((offset * areas[member, None]).T @ offset)[1][:, 0]
        normal = normal * np.sign(normal @ up) if abs(normal @ up) > LEVEL_NORMAL else up
        levels.append(LevelPlane(normal, float(middle @ normal), float(areas[member].sum())))
        rest = (np.abs(levels[-1].above(centers)) > 2 * width) & ~member
        normals, areas, centers = normals[rest], areas[rest], centers[rest]
    return levels


def find_bodies(surface: FieldSurface, levels: list[LevelPlane], layer: float, smallest: float,
                named: np.ndarray | None = None, clicked: np.ndarray = NOWHERE) -> list[FoundBody]:  # fmt: skip
    """Bodies without names that stand on level planes, completely within the trained space; touching ones count as one.

    A piece that carries a level plane itself, like a table, is scenery, and so is one that reaches the end of the
    trained space. A piece that rises less than `smallest` above its plane stays part of it, unless its vertices are
    `named` [V] bool by masks, or a point of it was `clicked` [K, 3].
    """
    volume = surface.volume
    solid = volume.values < 0
    vertices = surface.raw.vertices[np.unique(surface.raw.faces[surface.kept])]
    seen = surface.raw.vertices[surface.seen]
    x, y, z = np.ix_(*volume.axes())
    at_rim = np.sqrt(x**2 + y**2 + z**2) > RIM - 2 * volume.cell
    taken = np.zeros(solid.shape, bool)
    found: list[FoundBody] = []
    # From the top down: bodies on a table are taken before the table itself is examined.
    for level in sorted(levels, key=lambda level: -level.height):
        height = volume.along(level.normal).astype(np.float32) - level.height
        label = np.empty(solid.shape, np.int32)
        count = int(ndimage.label(solid & (height > layer), output=label))  # type: ignore[arg-type]
        others = [other for other in levels if other is not level and level.above(other.height * other.normal) > layer]
        samples = np.bincount(label.ravel())
        lowest = np.full(count + 1, np.inf, np.float32)
        np.minimum.at(lowest, label[label > 0], height[label > 0])
        hangs = lowest > layer + 1.5 * volume.cell
        for number, box in enumerate(ndimage.find_objects(label, count), start=1):
            mine = label[box] == number
            if (at_rim[box] & mine).any() or (taken[box] & mine).any() or mine.sum() < FEWEST_SAMPLES:
                continue
            low = volume.low + volume.cell * np.array([part.start for part in box])
            sides = volume.cell * np.array(mine.shape)
            place = Volume(mine.astype(np.float32), low, volume.cell)
            known = named is not None and _share_seen(place, vertices, surface.raw.vertices[named]) > SEEN_SHARE
            known = known or bool(_near(place, clicked).any())
            if height[box][mine].max() < smallest and not known:
                continue
            if any(_carries(place, other, volume.cell) for other in others) and not known:
                continue
            if not _stands(volume, place, mine & (height[box] < layer + 1.5 * volume.cell), level, layer):
                continue
            if _share_seen(place, vertices, seen) < SEEN_SHARE and not known:
                continue
            taken[box] |= mine
            crumbs = hangs & (samples < CRUMB * samples[number])
            standing = (label > 0) & ~crumbs[label]
            found.append(_body(volume, standing, box, mine, level, layer, float(sides.max())))
    return found


def bodies_with(surface: FieldSurface, levels: list[LevelPlane], layer: float, smallest: float, clicked: np.ndarray
                ) -> list[FoundBody]:  # fmt: skip
    """`find_bodies` for points [K, 3] that were clicked. A level plane on a body's own side, like the cover of a book
    below another book, would turn the body into scenery: while a point is in no body, the smallest plane is dropped."""
    most: list[FoundBody] = []
    reached = -1
    for count in range(len(levels), 0, -1):
        found = find_bodies(surface, levels[:count], layer, smallest, None, clicked)
        held = sum(any(_holds(surface, body, point) for body in found) for point in clicked)
        if held > reached:
            most, reached = found, held
        if held == len(clicked):
            break
    return most


def _holds(surface: FieldSurface, body: FoundBody, point: np.ndarray) -> bool:
    """Whether a point [3] on the surface belongs to a body."""
    return bool(_near(Volume(_within(surface, body).astype(np.float32), body.low, body.cell), point[None])[0])


def _near(place: Volume, points: np.ndarray) -> np.ndarray:
    """Which points [P, 3] lie within two samples of those that are set."""
    at = place.low + place.cell * np.argwhere(place.values > 0)
    return KDTree(at).query(points)[0] < 2 * place.cell if len(points) and len(at) else np.zeros(len(points), bool)


def _carries(place: Volume, other: LevelPlane, cell: float) -> bool:
    """Whether a large part of the samples right below a level plane belong to one component."""
    below = -other.above(place.points())
    return float((place.values * ((below > 0) & (below <= cell))).sum()) * cell**2 > CARRIED * other.area


def _stands(volume: Volume, place: Volume, lowest: np.ndarray, level: LevelPlane, layer: float) -> bool:
    """Whether a component's lowest samples have the plane's solid below them, and cover only a part of the plane."""
    points = place.points()[lowest]
    if not len(points) or len(points) * volume.cell**2 / 1.5 > LARGEST_FOOT * level.area:
        return False
    down = level.above(points) + 0.5 * layer
    return float((volume.at(points - down[:, None] * level.normal) < 0).mean()) > STANDS


def _share_seen(place: Volume, vertices: np.ndarray, seen: np.ndarray) -> float:
    """Share of the surface vertices at a component that belong to a given set, such as those seen by photos."""

    def here(points: np.ndarray) -> int:
        inside = (points > place.low - place.cell) & (points < place.low + place.cell * np.array(place.values.shape))
        near = points[inside.all(1)]
        grown = replace(place, values=ndimage.binary_dilation(place.values > 0).astype(np.float32))
        return int((grown.at(near) > 0.5).sum()) if len(near) else 0

    return here(seen) / max(here(vertices), 1)


def _body(volume: Volume, standing: np.ndarray, box: tuple[slice, ...], mine: np.ndarray, level: LevelPlane,
          layer: float, size: float) -> FoundBody:  # fmt: skip
    """The body of one component: all samples around it that are nearer to it than to the rest on the plane."""
    margin = int(np.ceil((FILLET + 1) * layer / volume.cell)) + 1
    start = [max(part.start - margin, 0) for part in box]
    wide = tuple(slice(low, part.stop + margin) for low, part in zip(start, box, strict=True))
    label = standing[wide].astype(np.int8)
    inner = tuple(slice(part.start - low, part.stop - low) for low, part in zip(start, box, strict=True))
    label[inner][mine] = 2
    away, nearest = ndimage.distance_transform_edt(label == 0, return_indices=True)  # type: ignore[misc]
    own = (label[tuple(nearest)] == 2) & (away * volume.cell <= FILLET * layer)
    corner = volume.low + volume.cell * np.array(start)
    body = FoundBody("", level, size, own, corner, volume.cell, layer, np.zeros((0, 0), bool), np.zeros(2))
    frame = frame_of(level.normal)
    flat = (corner + volume.cell * np.argwhere(own)) @ frame[:2].T
    a, b = (np.arange(low, high, 0.5 * volume.cell) for low, high in zip(flat.min(0), flat.max(0), strict=True))
    points = np.stack(np.meshgrid(a, b, indexing="ij"), -1).reshape(-1, 2) @ frame[:2]
    if not np.isfinite(level.height):
        return body
    points += (level.height + layer) * level.normal
    cut = ((volume.at(points) < 0) & body.owns(points)).reshape(len(a), len(b))
    return replace(body, hollow=np.asarray(ndimage.binary_fill_holes(cut)) & ~cut, corner=flat.min(0))


def body_mesh(body: FoundBody, field: Distance, cell: float) -> Mesh | None:
    """The closed mesh of a body, sampled `cell` apart along its plane; crumbs are left out. None if it is so thin that
    no sample is inside."""
    frame = frame_of(body.level.normal)
    turned = (body.low + body.cell * np.argwhere(body.own)) @ frame.T
    low, high = turned.min(0), turned.max(0)
    low[2] = max(low[2], body.level.height - 2 * cell)
    distance = body.distance(field)
    volume = sample_box(lambda p: distance(p @ frame), low - 2 * cell, high + 2 * cell, cell)
    if not (volume.values < 0).any():
        return None
    sampled = volume.mesh()
    mesh = Mesh(sampled.vertices @ frame, sampled.faces)
    label = components(mesh)
    area = np.bincount(label, face_normals(mesh)[1])
    return keep_faces(mesh, (area > FLAKE * area.max())[label])


def without_bodies(volume: Volume, bodies: list[FoundBody], field: Distance) -> Volume:
    """The scenery without bodies: their space is empty, and their plane continues below them. `volume` holds samples of
    `field`, the signed distance."""
    values = volume.values.copy()
    for body in bodies:
        part = body.part_of(volume)
        points = (body.low + volume.cell * np.indices(body.own.shape).reshape(3, -1).T).astype(np.float64)
        height, lifted, holds = body.level.above(points), body.lifted(points), body.holds(points)
        own = body.owns(lifted) | holds
        inside = values[part].reshape(-1).copy()
        over = own & (height > 0)
        # A body without a known support leaves a dent that ends at its seam.
        gone = height if np.isfinite(body.level.height) or body.seam is None else -body.seam.at(points)
        inside[over] = np.maximum(inside[over], gone[over])
        # The field has no data below its foot: there the plane's solid continues, and holes in it are closed.
        under = np.flatnonzero(own & (height <= 0) & (height > -2 * body.layer))
        foot = under[holds[under] | (sample(field, lifted[under]) < 0.5 * body.layer)] if len(under) else under
        inside[foot] = np.minimum(inside[foot], height[foot])
        # The two nearest samples define the surface between them: deep inside the removed body, the lower one would
        # lift it by up to a sample.
        near = foot[height[foot] > -ON * volume.cell]
        inside[near] = height[near]
        values[part] = inside.reshape(body.own.shape)
    return replace(volume, values=values)


@dataclass(frozen=True)
class Parts:
    """The parts of a scene, in normalised space."""

    solid: Mesh | None  # closed mesh of the scenery; None if there are bodies alone
    shown: Mesh | None  # its displayed mesh: the visible surface, and the places where bodies stood
    bodies: dict[str, Mesh]  # closed mesh of each body by name, with colours; the largest first
    smallest: float  # pieces lower than this above their plane stayed part of the scenery
    # names of two touching bodies, and "masks", "clicks" or "shape", which separated them
    touching: list[tuple[str, str, str]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # names of masks or clicks without a body
    noise: list[float] = field(default_factory=list)  # longest sides of pieces that are noise
    unrefined: dict[str, str] = field(default_factory=dict)  # by body, why its surface was not refined by photos
    # by body, the symmetry that completes what photos do not show, and the share of the surface that it guessed
    symmetries: dict[str, tuple[str, float]] = field(default_factory=dict)


def split(surface: FieldSurface, distance: Distance, finest: float, poses: PosedPhotos, photos_folder: Path,
          up: np.ndarray, *, alone: bool, clicked: dict[str, np.ndarray] | None = None) -> Parts:  # fmt: skip
    """Finds bodies, takes them out of the scenery and separates those that touch. Points [K, 3] of the surface that
    were `clicked` give bodies their names. Raises SdfsimError if masks do so as well.

    All is in normalised space: the poses, `up` [3] and the signed distance of the surface; `finest` is the width of a
    cell of the field's finest grid. `alone`: there is no scenery, only bodies.
    """
    smallest, layer, lift = SMALLEST * finest, LAYER * finest, LIFT * surface.volume.cell
    names, clicked = load_names(photos_folder), clicked or {}
    if names and clicked:
        message = f"body: the photos have masks of {', '.join(names)} already"
        raise SdfsimError(message, "give either masks of bodies or --body")
    names = names or list(clicked)
    if alone and not names:
        return Parts(None, None, whole_bodies(surface), smallest)
    blocking = Caster(surface.raw)
    sight = Visibility(surface.raw, lift, blocking)
    scene, votes = Scene(surface.raw, blocking, sight, poses.views, photos_folder), None
    if names and not clicked:
        votes = count_votes(sight, surface.raw.faces, poses.views, partial(load_labels, photos_folder), names)
    if alone:
        whole = [_whole(surface, mesh, up, layer) for mesh in whole_bodies(surface).values()]
    else:
        named = None if votes is None else votes.winner > 0
        # Masks separate a body from one that lies on it; the plane between them does not.
        plain = surface.shown if named is None else surface.shown & ~named[surface.raw.faces].any(1)
        levels = find_level_planes(keep_faces(surface.raw, plain), up, finest)
        if clicked:
            whole = bodies_with(surface, levels, layer, smallest, np.concatenate(list(clicked.values())))
        else:
            whole = find_bodies(surface, levels, layer, smallest, named)
    pieces: list[FoundBody] = []
    touching: list[tuple[FoundBody, FoundBody, str]] = []
    for body in whole:
        found, by, name = _parted(surface, body, votes, smallest, clicked, scene)
        found = _merged(surface, body, found)
        parts = [_piece(body, part, names[part.number - 1] if part.number else "") for part in found]
        touching += [(parts[k], parts[n], by) for k, part in enumerate(found) for n in part.neighbours if n > k]
        pieces += parts or [replace(body, name=name)]
    if votes is not None and not alone:
        for number, name in enumerate(names, start=1):
            if name not in [body.name for body in pieces]:
                loose = _loose(surface, votes, number, whole, up, layer, smallest)
                whole, pieces = [*whole, *loose], [*pieces, *(replace(body, name=name) for body in loose)]
    largest = {body.name: body.size for body in sorted(pieces, key=lambda body: body.size)}
    pieces = [body for body in pieces if not body.name or body.size > SCRAP * largest[body.name]]
    sampled: dict[FoundBody, Mesh] = {}
    for body in (body for body in pieces if _is_seen(surface, body)):
        mesh = body_mesh(body, distance, min(max(FINER * finest, body.size / ENOUGH), surface.volume.cell))
        if mesh is not None:
            sampled[body] = mesh
    if not sampled:
        return Parts(surface.solid, surface.visible, {}, smallest, missing=names)
    noise = _noise(sampled, poses.sparse.xyz, finest)
    called = _names([body for body in sampled if body not in noise])
    grown: list[tuple[FoundBody, Mesh]] = []
    meshes, unrefined, symmetries, pictures = {}, {}, {}, load_grey_photos(poses.views, photos_folder)
    for body, name in called.items():
        # Lifted off the occluding surface, which is sampled more coarsely.
        mesh, why = refine(sampled[body], pictures, blocking, lift, finest, body.level.above, body.layer)
        if why:
            unrefined[name] = why
        sight = Visibility(mesh, lift, blocking)
        whole_of = completed(Known(mesh, evidence_of(sight, poses.views), poses.views, blocking, finest), up)
        if whole_of is not None:
            mesh, symmetries[name] = whole_of.mesh, (whole_of.symmetry.name, whole_of.guessed)
            grown.append((body, mesh))
            sight = Visibility(mesh, lift, blocking)
        seen = look(sight, poses.views, photos_folder)
        known, color = seen.weight > 0, seen.color
        if known.any() and not known.all():
            color[~known] = spread_colors(mesh.vertices[~known], mesh.vertices[known], color[known])
        meshes[name] = replace(mesh, colors=to_bytes(color))
    solid, shown = (None, None) if alone else scenery(surface, whole, distance, grown)
    pairs = [(called[a], called[b], by) for a, b, by in touching if a in called and b in called]
    missing = [name for name in names if name not in meshes]
    return Parts(
        solid,
        shown,
        meshes,
        smallest,
        pairs,
        missing,
        [body.size for body in pieces if body not in called],
        unrefined,
        symmetries,
    )


def _parted(surface: FieldSurface, body: FoundBody, votes: Votes | None, smallest: float,
            clicked: dict[str, np.ndarray], scene: Scene) -> tuple[list[Part], str, str]:  # fmt: skip
    """The parts of a body, empty for a single one; what separates them: "masks", "clicks" or "shape"; and the name from
    masks or clicks for a single one."""
    solid = _solid(surface, body)
    assert surface.raw.colors is not None
    points = {number: points[[_holds(surface, body, point) for point in points]]
              for number, points in enumerate(clicked.values(), start=1)}  # fmt: skip
    if points := {number: some for number, some in points.items() if len(some)}:
        parts = parts_by_clicks(solid, surface.raw.colors[solid.index], points, scene, smallest)
        return parts, "clicks", "" if parts else [*clicked][next(iter(points)) - 1]
    if votes is not None:
        parts, number = parts_by_votes(solid, votes)
        if parts or number:
            return parts, "masks", "" if parts else votes.names[number - 1]
    if np.isfinite(body.level.height):
        return parts_by_shape(solid, surface.raw.colors[solid.index], smallest), "shape", ""
    return [], "", ""


def _is_seen(surface: FieldSurface, body: FoundBody) -> bool:
    """Whether `FEW` photos show any of a body: what none of them shows is made up by the training."""
    place = Volume(_within(surface, body).astype(np.float32), body.low, body.cell)
    if body.seam is not None:
        own = body.seam.at(place.points().reshape(-1, 3)).reshape(place.values.shape) < 0
        place = replace(place, values=place.values * own)
    shown = surface.raw.vertices[surface.views >= FEW]
    return _share_seen(place, surface.raw.vertices, shown) > SEEN_BY_FEW


def _merged(surface: FieldSurface, body: FoundBody, parts: list[Part]) -> list[Part]:
    """The parts of a body; those that no photos show, such as one inside of another, go to a neighbour. Empty if one is
    left."""
    shown = [_is_seen(surface, _piece(body, part, "")) for part in parts]
    goes = {k: next((n for n in part.neighbours if shown[n]), k) for k, part in enumerate(parts) if not shown[k]}
    stays = [k for k in range(len(parts)) if goes.get(k, k) == k]
    merged = []
    for k in stays:
        group = [k, *(n for n, to in goes.items() if to == k != n)]
        values = np.min([parts[n].seam.values for n in group], axis=0)
        beside = {goes.get(n, n) for one in group for n in parts[one].neighbours} - {k}
        merged.append(replace(parts[k], seam=replace(parts[k].seam, values=values),
                              neighbours=sorted(stays.index(n) for n in beside)))  # fmt: skip
    return merged if len(merged) > 1 else []


def _solid(surface: FieldSurface, body: FoundBody) -> ConnectedSolid:
    """The solid of a body above its contact layer."""
    around = Volume(surface.volume.values[body.part_of(surface.volume)], body.low, body.cell)
    return solid_of(around, _within(surface, body), surface.raw)


def _within(surface: FieldSurface, body: FoundBody) -> np.ndarray:
    """[X, Y, Z] bool, of the samples of `own` those within a body and above its contact layer."""
    around = Volume(surface.volume.values[body.part_of(surface.volume)], body.low, body.cell)
    return body.own & (around.values < 0) & (body.level.above(around.points()) > body.layer)


def _piece(body: FoundBody, part: Part, name: str) -> FoundBody:
    """One part of a body, with only the samples that it needs."""
    mine = body.own & (part.seam.values < 0)
    box = ndimage.find_objects(ndimage.binary_dilation(mine, iterations=3).astype(np.int8))[0]
    size = max(np.ptp(places) for places in np.nonzero(mine)) * body.cell
    low = body.low + body.cell * np.array([side.start for side in box])
    return replace(body, name=name, seam=part.seam, own=body.own[box], low=low, size=float(size))


def _whole(surface: FieldSurface, mesh: Mesh, up: np.ndarray, layer: float) -> FoundBody:
    """A connected component of the solid, given by its mesh, as a body without a support."""
    volume = surface.volume
    label = ndimage.label(volume.values < 0)[0]  # type: ignore[index]
    at = np.round((mesh.vertices - volume.low) / volume.cell).astype(int)
    touched = ndimage.maximum_filter(label, 3)[tuple(at.T)]
    mine = label == np.bincount(touched[touched > 0]).argmax()
    return _at_nothing(volume, mine, volume.values < 0, up, layer)


def _at_nothing(volume: Volume, mine: np.ndarray, solid: np.ndarray, up: np.ndarray, layer: float) -> FoundBody:
    """The body of some samples `mine` [X, Y, Z] of a solid without a known support."""
    box = ndimage.find_objects(mine.astype(np.int8))[0]
    size = max(part.stop - part.start for part in box) * volume.cell
    return _body(volume, solid, box, mine[box], LevelPlane(up, -np.inf, 0.0), layer, size)


def _loose(surface: FieldSurface, votes: Votes, number: int, bodies: list[FoundBody], up: np.ndarray, layer: float,
           smallest: float) -> list[FoundBody]:  # fmt: skip
    """The body with masks that stands on no plane, cut off from its neighbours; None if there is too little of it."""
    volume = surface.volume
    vertices = surface.raw.vertices
    index = np.flatnonzero((votes.winner == number) & ~np.any([body.owns(vertices) for body in bodies] or [False], 0))
    if not len(index) or np.ptp(vertices[index], axis=0).max() < smallest:
        return []
    margin = 8 * volume.cell
    low, high = vertices[index].min(0) - margin, vertices[index].max(0) + margin
    start = np.maximum(((low - volume.low) / volume.cell).astype(int), 0)
    stop = np.minimum(((high - volume.low) / volume.cell).astype(int) + 1, volume.values.shape)
    box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
    part = Volume(volume.values[box], volume.low + volume.cell * start, volume.cell)
    inside = np.pad(part.values[1:-1, 1:-1, 1:-1] < 0, 1)
    found = part_of_name(solid_of(part, inside, surface.raw), votes, number)
    if found is None:
        return []
    mine = np.zeros(volume.values.shape, bool)
    mine[box] = inside & (found.seam.values < 0)
    body = _at_nothing(volume, mine, mine, up, layer)
    return [replace(body, seam=found.seam)]


def _noise(meshes: dict[FoundBody, Mesh], points: np.ndarray, width: float) -> list[FoundBody]:
    """The bodies that are only noise: dark or blurred places that the training filled.

    They are small, have no masks, and almost none of the sparse points [P, 3] lies within `width` of them, while other
    bodies are covered with points.
    """
    area = np.array([face_normals(mesh)[1].sum() for mesh in meshes.values()])
    trees = [KDTree(mesh.vertices) for mesh in meshes.values()]
    near = [np.isfinite(tree.query(points, distance_upper_bound=width)[0]).sum() for tree in trees]
    density = np.array(near) / area
    bare = (area < SMALL_NOISE * area.max()) & (density < BARE * density.max())
    return [body for body, without in zip(meshes, bare, strict=True) if without and not body.name]


def _names(bodies: list[FoundBody]) -> dict[FoundBody, str]:
    """A unique name for each body, the largest first: that of its masks, or else a number."""
    names: dict[FoundBody, str] = {}
    taken = {body.name for body in bodies}
    for body in sorted(bodies, key=lambda body: -body.size):
        name = body.name
        if not name or name in names.values():
            stem, first = (f"{name}_", 2) if name else ("object", 1)
            name = next(f"{stem}{n}" for n in itertools.count(first) if f"{stem}{n}" not in {*names.values(), *taken})
        names[body] = name
    return names


def whole_bodies(surface: FieldSurface) -> dict[str, Mesh]:
    """Every connected component of the solid that is seen as a body, the largest first; one in any case."""
    solid = surface.solid
    label, area = components(solid), face_normals(solid)[1]
    shown = (surface.views >= FEW)[surface.raw.faces[surface.kept]].any(1)
    total = np.bincount(label, area)
    seen = np.bincount(label, area * shown) > SEEN_BY_FEW * total
    order = [k for k in np.argsort(-total) if seen[k]] or [int(total.argmax())]
    return {f"object{n}": keep_faces(solid, label == k) for n, k in enumerate(order, start=1)}


def emptied(volume: Volume, grown: list[tuple[FoundBody, Mesh]]) -> Volume:
    """The scenery without what lies above the planes of bodies within their completed meshes, such as a shard in a hole
    of a floor that the completion has closed."""
    values = volume.values.copy()
    for body, mesh in grown:
        low, high = mesh.vertices.min(0) - 2 * volume.cell, mesh.vertices.max(0) + 2 * volume.cell
        start = np.maximum(np.floor((low - volume.low) / volume.cell).astype(int), 0)
        stop = np.minimum(np.ceil((high - volume.low) / volume.cell).astype(int) + 1, values.shape)
        box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
        part = replace(volume, values=values[box], low=volume.low + volume.cell * start)
        points = part.points().reshape(-1, 3)
        height, nearest = body.level.above(points), ClosestPoint(mesh)
        over = np.flatnonzero((height > 0) & np.isfinite(height))
        away = np.linalg.norm(points[over] - nearest(points[over])[0], axis=1)
        over = over[nearest.odd(points[over]) | (away < volume.cell)]
        inside = part.values.reshape(-1).copy()
        inside[over] = np.maximum(inside[over], np.minimum(height[over], volume.cell))
        values[box] = inside.reshape(part.values.shape)
    return replace(volume, values=values)


def scenery(surface: FieldSurface, bodies: list[FoundBody], distance: Distance,
            grown: list[tuple[FoundBody, Mesh]]) -> tuple[Mesh, Mesh]:  # fmt: skip
    """The scenery's solid without bodies, of which some have `grown` by completion, and its displayed mesh."""
    raw, mesh = surface.raw, emptied(without_bodies(surface.volume, bodies, distance), grown).mesh()
    assert raw.colors is not None
    # Away from cuts, the vertices are those of the whole surface, and take its attributes.
    away, nearest = KDTree(raw.vertices).query(mesh.vertices, distance_upper_bound=1e-6)
    same, nearest = np.isfinite(away), np.minimum(nearest, len(raw.vertices) - 1)
    shown = same & _at_faces(raw, surface.shown)[nearest]
    color = raw.colors[nearest].astype(float)
    color[~same] = spread_colors(mesh.vertices[~same], mesh.vertices[shown], color[shown])
    mesh = replace(mesh, colors=to_bytes(color))
    # Components without any of the earlier surface are pockets left by the cut.
    label = components(mesh)
    belongs = (same & _at_faces(raw, surface.kept)[nearest])[mesh.faces].any(1)
    closed = (np.bincount(label, belongs) > 0)[label]
    displayed = islands(mesh, closed & (shown | ~same)[mesh.faces].all(1), FLOATER)
    return keep_faces(mesh, closed), keep_faces(mesh, displayed)


def _at_faces(mesh: Mesh, faces: np.ndarray) -> np.ndarray:
    """Vertices [V] bool that some faces [F] bool use."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces[faces]] = True
    return used
