"""Moves reconstructed bodies out of their support, or out of each other.

A field does not separate bodies that touch: each surface is off by a part of a cell, so a jar may start some
millimetres deep in its table. A simulation would throw it out at once, with energy from nothing.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import nnls

from sdfsim.evaluation.true_surfaces import Placed, TrueSurface, gaps, of_mesh, true_surface
from sdfsim.geometry.mesh import Mesh
from sdfsim.physics.pose import to_matrix
from sdfsim.scene.collision_filter import contact_groups
from sdfsim.scene.scene import Body, Scene
from sdfsim.sdf.closed_forms import ClosedForm, PlaneSdf
from sdfsim.shape.shape import Shape

UPRIGHT = 2.0  # straight up is preferred to any move that is not shorter by this factor
TOUCHES = 2e-5  # of a body's thickness: up to this depth a body only touches another
ROUNDS = 40  # of steps on the way out


@dataclass(frozen=True)
class Cleared:
    """The result for a body that overlapped others."""

    shift: np.ndarray  # [3] m, by which it is moved
    into: tuple[str, ...]  # names of the bodies that it overlapped
    left: float  # m, how deep it still is in one of these; 0 if it is out
    held: bool = False  # by a joint


def cleared(scene: Scene, solids: dict[str, Mesh]) -> dict[str, Cleared]:
    """Bodies that overlap others at the start, by name, with the shortest moves that separate them: upwards, unless
    another direction is much shorter. Lower bodies are moved first, and the bodies on them follow.

    Bodies in joints stay at their place, and others move away from them. A body also stays if it would have to move by
    more than its own thickness, as out of a hollow that is too tight. `solids` are closed meshes of bodies, in their
    own frames, for shapes with an open mesh. Depth is measured on these and on the simulated distances.
    """
    holders = {frozenset(joint.bodies) for joint in scene.joints if not joint.collides}
    held = {index for joint in scene.joints for index in joint.bodies}
    group, allowed = contact_groups(scene.bodies)
    strength = float(np.linalg.norm(scene.gravity))
    up = -scene.gravity / strength if strength else np.array([0.0, 0.0, 1.0])
    bodies = [_Solid(body, scene.shapes[body.shape], solids.get(body.name)) for body in scene.bodies]
    free = [k for k, body in enumerate(scene.bodies) if body.motion == "dynamic" and k not in held]
    free.sort(key=lambda k: float((bodies[k].points @ up).min()))
    settled = [k for k in range(len(bodies)) if k not in free]
    found: dict[str, Cleared] = {}

    def touchable(k: int, others: list[int]) -> list[_Solid]:
        return [bodies[n] for n in others if allowed[group[k], group[n]] and frozenset((k, n)) not in holders]

    for k in sorted(index for index in held if index >= 0 and scene.bodies[index].motion == "dynamic"):
        still = [n for n in settled if scene.bodies[n].motion != "dynamic"]
        if hits := _Way(bodies[k], touchable(k, still)).hits(np.zeros(3)):
            left = max(depth for depth, _ in hits.values())
            found[scene.bodies[k].name] = Cleared(np.zeros(3), tuple(hits), left, held=True)
    for k in free:
        way = _Way(bodies[k], touchable(k, settled))
        if hits := way.hits(np.zeros(3)):
            shift = way.out(up)
            left = 0.0 if shift is not None else max(depth for depth, _ in hits.values())
            found[scene.bodies[k].name] = one = Cleared(np.zeros(3) if shift is None else shift, tuple(hits), left)
            bodies[k].move(one.shift)
        settled.append(k)
    return found


class _Solid:
    """A body at its place in the scene, and at its moved place."""

    def __init__(self, body: Body, shape: Shape, solid: Mesh | None) -> None:
        self.name, self.scale, self._shape, self._mesh = body.name, body.scale, shape, solid or shape.mesh
        self._closed_form = solid is None and isinstance(shape.sdf, ClosedForm)
        self._turn, self._place = to_matrix(body.quat_xyzw), body.position
        # [V, 3] m on its surface, in the world; none of a plane
        self.points = np.zeros((0, 3))
        if not isinstance(shape.sdf, PlaneSdf):
            local = np.concatenate([self._mesh.vertices[np.unique(self._mesh.faces)], shape.nodes])
            self.points = body.position + body.scale * local @ self._turn.T

    @cached_property
    def surface(self) -> TrueSurface:
        return true_surface(self._shape) if self._closed_form else of_mesh(self._mesh)

    def move(self, shift: np.ndarray) -> None:
        self._place, self.points = self._place + shift, self.points + shift

    def placed(self, number: int, shift: np.ndarray) -> Placed:
        """The form that `gaps` takes, moved by a shift."""
        return Placed(np.array([number]), np.array([self.scale]), (self._place + shift)[None], self._turn[None])

    def ask(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distances [P] m and their gradients [P, 3] at points of the world [P, 3]."""
        local = (points - self._place) @ self._turn / self.scale
        distance, slope = self.surface.distance(local)
        if not self._closed_form:
            simulated, towards = (np.asarray(part) for part in self._shape.sdf(local))
            deeper = simulated < distance
            distance, slope = np.where(deeper, simulated, distance), np.where(deeper[:, None], towards, slope)
        return distance * self.scale, slope @ self._turn.T


class _Way:
    """Search for one body's way out of others."""

    def __init__(self, body: _Solid, others: list[_Solid]) -> None:
        self.body, self.most = body, body.scale * body.surface.thickness
        self.touches = TOUCHES * self.most if np.isfinite(self.most) else 0.0
        self.pairs = [_Pair(body, other, self.most) for other in others]
        self.pairs = [pair for pair in self.pairs if pair.near]

    def hits(self, shift: np.ndarray) -> dict[str, tuple[float, np.ndarray]]:
        """The overlaps of the body after a shift: by name the depth, m, and the direction out [3]."""
        found = {}
        for pair in self.pairs:
            # Even without a point inside, two edges may cross: that search takes longer.
            for measure in (pair.deepest_point, pair.deepest):
                depth, normal = measure(shift)
                if depth > self.touches:
                    found[pair.other.name] = (depth, normal)
                    break
        return found

    def out(self, up: np.ndarray) -> np.ndarray | None:
        """The shift [3] m that takes the body out; None if there is no short one."""
        straight, shortest = self._along(up), self._shortest()
        if straight is None or (shortest is not None and straight > UPRIGHT * np.linalg.norm(shortest)):
            return shortest
        return straight * up + 0.0

    def _along(self, direction: np.ndarray) -> float | None:
        """The shortest way along a direction, m. Distances grow no faster than the way, so a step by the depth never
        goes too far."""
        way = 0.0
        for _ in range(ROUNDS):
            hits = self.hits(way * direction)
            if not hits:
                return way
            way += max(depth for depth, _ in hits.values())
            if way > self.most:
                break
        return None

    def _shortest(self) -> np.ndarray | None:
        """The shortest shift that takes the body out of all others, according to the contact planes found so far."""
        shift, normals, least = np.zeros(3), [], []
        for _ in range(ROUNDS):
            hits = self.hits(shift)
            if not hits:
                return shift
            for depth, normal in hits.values():
                normals.append(normal)
                least.append(float(normal @ shift) + depth)
            # The least |shift| with normals @ shift >= least (Lawson and Hanson's LDP).
            table = np.vstack([np.transpose(normals), least])
            residual = table @ nnls(table, np.array([0.0, 0.0, 0.0, 1.0]))[0] - [0.0, 0.0, 0.0, 1.0]
            if residual[3] > -1e-9:
                return None
            shift = -residual[:3] / residual[3] + 0.0  # avoids negative zeros
            if np.linalg.norm(shift) > self.most:
                return None
        return None


class _Pair:
    """A body and another one that it may overlap: the depth after a shift of at most `most` m."""

    def __init__(self, body: _Solid, other: _Solid, most: float) -> None:
        self.body, self.other = body, other
        self.mine, self._free = _beside(body.points, other, most)
        self.theirs, self._taken = _beside(other.points, body, most)
        self.near = bool(len(self.mine) or len(self.theirs)) or _meet(body.points, other.points, most)

    def deepest(self, shift: np.ndarray) -> tuple[float, np.ndarray]:
        """The depth, m, and the direction out [3]."""
        solids = [self.body.surface, self.other.surface]
        gap = gaps(solids, self.body.placed(0, shift), self.other.placed(1, np.zeros(3)), np.zeros(1))
        return -float(gap.apart[0]), gap.sign[0] * gap.normal[0]

    def deepest_point(self, shift: np.ndarray) -> tuple[float, np.ndarray]:
        """The same from the points of both surfaces only."""
        found = (0.0, np.zeros(3))
        length = float(np.linalg.norm(shift))
        for points, away, solid, sense in (
            (self.mine, self._free, self.other, 1.0),
            (self.theirs, self._taken, self.body, -1.0),
        ):
            points = points[away <= length]
            if len(points):
                distance, slope = solid.ask(points + sense * shift)
                lowest = int(distance.argmin())
                found = max(found, (-float(distance[lowest]), sense * slope[lowest]), key=lambda hit: hit[0])
        return found


def _meet(one: np.ndarray, other: np.ndarray, most: float) -> bool:
    """Whether the boxes around points [P, 3] and [Q, 3] come within `most` m of each other."""
    if not len(one) or not len(other):
        return False
    return bool((np.maximum(one.min(0), other.min(0)) - np.minimum(one.max(0), other.max(0)) <= most).all())


def _beside(points: np.ndarray, solid: _Solid, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Those of points [P, 3] that are no more than `most` m from a solid, and how far they are from it."""
    if len(solid.points):
        low, high = solid.points.min(0) - most, solid.points.max(0) + most
        points = points[((points >= low) & (points <= high)).all(1)]
    if not len(points):
        return points, np.zeros(0)
    away = solid.ask(points)[0]
    return points[away <= most], away[away <= most]
