"""Everyday scenes that any rigid-body simulator should get right, each with the right answer in closed form."""

from collections.abc import Iterator, Sequence
from math import cos, hypot, inf, pi, radians, sin, sqrt

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.evaluation.instruments import DEEP
from sdfsim.evaluation.laws.scenes import (
    FACETS,
    LEG,
    STILL,
    UNIT,
    Check,
    G,
    Put,
    Ran,
    Setting,
    about,
    fixed,
    floor,
    most,
    run,
    solid,
)
from sdfsim.shape.make import shape_from_primitive
from sdfsim.shape.shape import Shape


def slender(at: Setting) -> Iterator[Check]:
    """Sticks that cross: their deepest overlap stays below a hundredth of the thinner one's width."""
    beam = at.box(10, 0.5, 0.5)
    top = Put("top", beam, [1, -0.3, 3.52], about("z", 90))
    ran = run(at, "one beam on another", [fixed("beam", beam, [0, 0, 3]), top], 1.0)
    # Its centre lies 5 mm outside the edge of the beam: in 0.12 s it turns by 1/2 (m g .005 / (m / 12)) t^2 = 0.24
    # degrees, and its centre stays at the height of the faces, 3.5, to 0.02.
    yield ran.near("height at 0.12 s", ran.place("top")[ran.when(0.12), 2], 3.5, 0.0, "sizes", 0.02)
    yield from ran.laws()

    rng = np.random.default_rng(1)
    passed, worst, count = 0, 0.0, 200 if at.full else 10
    for _ in range(count):
        sticks = []
        for name in ("lower", "upper"):
            aspect = float(np.exp(rng.uniform(np.log(5), np.log(50 if at.kind == "analytic" else 20))))
            width = 10 / round(aspect)
            form = ("box", "cylinder", "capsule")[rng.integers(3)]
            dims = (10.0, width, width) if form == "box" else (width / 2, 10.0)
            sticks.append((name, solid(at.kind, form, *dims), STILL if form == "box" else about("y", 90), width))
        (_, lower, lay, w1), (_, upper, lie, w2) = sticks
        across = about("z", rng.uniform(30, 150))
        place = [*rng.uniform(-2, 2, 2), 3 + (w1 + w2) / 2 + 0.02 * min(w1, w2)]
        pair = [fixed("lower", lower, [0, 0, 3], lay), Put("upper", upper, place, across * lie)]
        overlap = run(at, "random crossing", pair, 0.4).verdict.overlap
        part = overlap.part if overlap else 0.0
        passed += part > DEEP
        worst = max(worst, part)
    yield most(f"{count} random crossings: in each other", passed, 0)
    yield most(f"{count} random crossings: worst overlap", 100 * worst, 100 * DEEP, "% of width")


def heaps(at: Setting) -> Iterator[Check]:
    """A heap of 24 sticks, a log cabin, a plank on rails, a pencil over the rim of a bowl."""
    rng = np.random.default_rng(2)
    stick = at.box(10, 0.5, 0.5)
    bodies = [
        Put(f"stick {k}", stick, [*rng.uniform(-2, 2, 2), 1 + 0.7 * k], about("z", rng.uniform(0, 180)))
        for k in range(24)
    ]
    yield from run(at, "heap of 24 sticks", [*bodies, floor()], 6.0 if at.full else 3.0).laws()

    log, lie = (at.cylinder(0.25, 6.0), about("y", 90)) if at.kind == "analytic" else (at.box(6, 0.5, 0.5), STILL)
    logs = []
    for k in range(16):
        layer, side = k // 2, 2 * (k % 2) - 1
        turn = about("z", 90) if layer % 2 else STILL
        place = turn.apply([0, 2.4 * side, 0]) + np.array([0, 0, 0.25 + 0.5 * layer])
        logs.append(Put(f"log {k}", log, place, turn * lie, mu=0.7))
    ran = run(at, "log cabin of 16", [*logs, floor()], 2.0)
    yield ran.most("moved", max(float(np.abs(ran.place(p.name)[-1] - p.at).max()) for p in logs), 0.05, "sizes")
    yield from ran.laws()

    rail, plank = at.box(10, 0.3, 0.3), at.box(6, 2, 0.2)
    rails = [fixed(f"rail {k}", rail, [2 * k, 0.13, 0], about("z", 90)) for k in (-1, 1)]
    ran = run(at, "plank on rails", [*rails, Put("plank", plank, [0.3, 0.2, 0.25])], 2.0)
    yield ran.near("height", ran.place("plank")[-1, 2], 0.25, 0.0, "sizes", 0.002)
    yield ran.most("speed", np.abs(ran.v("plank")[-1]).max(), 1e-3, "m/s")
    yield from ran.laws()

    bowl = shape_from_primitive("bowl", 4.0, sdf="mesh" if at.kind == "mesh" else "grid", name="bowl")
    rim = float(bowl.mesh.vertices[:, 2].max())
    put = Put("pencil", at.cylinder(0.1, 6.0), [0.2, 0.6, rim + 0.101], about("y", 90))
    ran = run(at, "pencil over a bowl", [fixed("bowl", bowl, [0, 0, 0]), put], 1.0)
    yield ran.near("height", ran.place("pencil")[-1, 2], rim + 0.1, 0.0, "sizes", 0.01)
    yield from ran.laws()


def seams(at: Setting) -> Iterator[Check]:
    """Seams between flush tiles do not disturb a sliding body; only gravity acts at a step down."""
    cube = at.box(1, 1, 1)
    forms = {"cube": (cube, 0.5), "slab": (at.box(2, 2, 0.5), 0.25), "can": (at.cylinder(0.5, 1.0), 0.5)}
    tile, small = at.box(5, 10, 1), at.box(1, 10, 1)

    def tiles(gap: float = 0.0, down: float = 0.0) -> list[Put]:
        return [fixed("left", tile, [-2.5 - gap / 2, 0, -0.5]), fixed("right", tile, [2.5 + gap / 2, 0, -0.5 - down])]

    for name, (shape, height) in forms.items():
        for speed in (0.3, 2.0):
            put = Put("it", shape, [-1.2, 0.17, height], v=[speed, 0, 0], mu=0)
            ran = run(
                at, f"{name} at {speed:g} m/s without friction", [*tiles(), put], 0.4 / speed if speed > 1 else 0.8
            )
            yield ran.near("speed", ran.v("it")[-1, 0], speed, 0.01, "m/s")
            yield ran.most("tilt", ran.tilt("it").max(), 1.0, "degrees")
            yield from ran.laws()
        put = Put("it", shape, [-1.2, 0.17, height], v=[1.5, 0, 0], mu=0.5)
        ran = run(at, f"{name} with friction", [*tiles(), put], 0.6)
        yield ran.slid("it", put, 0.03)
        yield from ran.laws()
        ran = run(at, f"{name} at rest over a seam", [*tiles(), Put("it", shape, [0.2, 0.1, height])], 2.0)
        yield ran.most("moved", np.abs(ran.moved("it"))[:, :2].max(), 1e-3, "sizes")
        yield from ran.laws()
    put = Put("it", cube, [-1.2, 0.17, 0.5], v=[0.3, 0, 0], mu=0)
    ran = run(at, "cube over a gap of a hundredth", [*tiles(gap=0.01), put], 0.8)
    yield ran.near("speed", ran.v("it")[-1, 0], 0.3, 0.01, "m/s")
    yield from ran.laws()
    ran = run(at, "cube down a step of a hundredth", [*tiles(down=0.01), put], 0.8)
    # It may keep the energy of its fall as speed, and tips slightly in between; a wall would stop it.
    yield ran.between("speed", ran.v("it")[-1, 0], 0.3 * 0.97, sqrt(0.3**2 + 2 * G * 0.01 * UNIT), "m/s")
    row = [fixed(f"tile {k}", small, [k, 0, -0.5]) for k in range(-4, 12)]
    put = Put("it", cube, [-1.3, 0.17, 0.5], about("z", 20), v=[1.0, 0, 0], mu=0)
    ran = run(at, "turned cube over eight seams", [*row, put], 0.8)
    yield ran.near("speed", ran.v("it")[-1, 0], 1.0, 0.01, "m/s")
    yield ran.most("turned", np.degrees(np.abs(ran.turned("it"))).max(), 1.0, "degrees")


def thin_floors(at: Setting) -> Iterator[Check]:
    """A wide thin box carries bodies as a plane does."""
    cube = at.box(1, 1, 1)
    sheets = {"1000 x 1000 x 1": (1000, 1000, 1), "10 x 10 x 0.02": (10, 10, 0.02)}
    for name, size in sheets.items():
        # A grid cannot resolve a sheet of half a millimetre that is 10 m wide.
        sheet = solid("analytic" if at.kind == "grid" else at.kind, "box", *size)
        ground = fixed("ground", sheet, [0, 0, -size[2] / 2])
        deep = DEEP / size[2]  # a hundredth of the cube
        for place in ((0.0, 0.0), (0.3, 0.2)):
            ran = run(at, f"at rest on {name} at {place}", [ground, Put("cube", cube, [*place, 0.5])], 2.0)
            yield ran.near("height", ran.place("cube")[-1, 2], 0.5, 0.01, "sizes")
            yield ran.most("speed", np.abs(ran.v("cube")).max(), 0.01, "m/s")
            yield from ran.laws(deep)
        ran = run(at, f"dropped on {name}", [ground, Put("cube", cube, [0.3, 0.2, 1.5], e=0.0)], 1.5)
        yield ran.near("height", ran.place("cube")[-1, 2], 0.5, 0.01, "sizes")
        yield from ran.laws(deep)
        put = Put("cube", cube, [-2.0, 0.2, 0.5], v=[1.5, 0, 0], mu=0.5)
        yield run(at, f"sliding on {name}", [ground, put], 1.0).slid("cube", put, 0.01)


def rolling(at: Setting) -> Iterator[Check]:
    """Round bodies keep rolling, and accelerate down a slope with g sin a / (1 + k^2): a cylinder has k^2 = 1/2, a tube
    (1 + (inner / outer)^2) / 2."""
    lie, exact = about("x", 90), at.kind == "analytic"
    forms = {
        "can": (at.cylinder(0.5, 1.0), 0.5, 0.5),
        "disc": (at.cylinder(0.5, 0.1), 0.5, 0.5),
        "rod": (at.cylinder(0.1, 3.0), 0.1, 0.5),
    }
    if not exact:
        forms["hoop"] = (at.mesh("tube", 0.5, 0.45, 0.4), 0.5, (1 + (0.45 / 0.5) ** 2) / 2)
    grounds = {"plane": floor()}
    if at.full or not exact:
        grounds["box"] = fixed("box", solid("analytic", "box", 200, 20, 1), [80, 0, -0.5])
    seconds = 10.0 if at.full else 4.0
    for name, (shape, radius, k2) in forms.items():
        for under, ground in grounds.items():
            for speed in (0.01, 0.1, 1.0, 3.0):
                put = Put("it", shape, [0, 0, radius], lie, v=[speed, 0, 0], w=[0, speed / (radius * UNIT), 0], mu=1.0)
                ran = run(at, f"{name} at {speed:g} m/s on a {under}", [put, ground], seconds if speed < 2 else 2.0)
                last = hypot(*ran.v("it")[-1, :2]) / speed
                # A facet may stop it from rolling, or make it lose energy. A body that stands on an edge falls on a
                # facet; nothing else may make it faster.
                fall = 0.0 if exact else 2 * G * radius * UNIT * (1 - cos(pi / FACETS)) / (1 + k2)
                high = 100.1 * sqrt(1 + fall / speed**2)
                yield ran.between("speed", 100 * last, 99.0 if exact else -inf, high, "%")
                yield from ran.laws()
        for slope in (0.1, 0.5, 5.0, 10.0) if exact else (5.0, 10.0):
            put = Put("it", shape, [0, 0, radius], lie, mu=1.0)
            ran = run(at, f"{name} down {slope:g} degrees", [put, floor()], 2.0, tilt=slope)
            wanted = 0.5 * G * sin(radians(slope)) / (1 + k2) * ran.seconds[-1] ** 2 / UNIT
            least = 0.98 * wanted
            if not exact:
                # Minus one facet, as it may stand on one at first.
                rolled = _over_facets(slope, radius * UNIT, k2, ran.seconds[-1]) / UNIT
                least = 0.98 * rolled - 2 * radius * sin(pi / FACETS)
            yield ran.between("way", ran.place("it")[-1, 0], least, 1.02 * wanted, "sizes")
            yield from ran.laws()


def _over_facets(slope: float, radius: float, k2: float, seconds: float) -> float:
    """Distance in m that a polygon of `FACETS` corners rolls down a slope from rest if its impacts are inelastic: about
    the next corner that hits, its angular momentum is conserved."""
    turn, side = 2 * pi / FACETS, 2 * radius * sin(pi / FACETS)
    kept, pull = (k2 + cos(turn)) / (k2 + 1), G * sin(radians(slope)) / (1 + k2)
    way = speed = 0.0
    while seconds > 0:
        faster = sqrt(speed**2 + 2 * pull * side)
        seconds -= 2 * side / (speed + faster)
        way, speed = way + side, kept * faster
    return way


def facets(at: Setting) -> Iterator[Check]:
    """Faceted cylinders and icospheres never gain energy, lose no more than a polygon with inelastic impacts, and rest
    on slopes below half the angle of a facet."""
    for count in (16, 32):
        can = at.mesh("cylinder", 0.5, 1.0, count)
        # Turned so that it stands on a facet: its centre is at the apothem's height.
        low = 0.5 * cos(pi / count)
        lie = about("x", 90) * about("z", 180 / count)
        speed = 1.0
        put = Put("can", can, [0, 0, low], lie, v=[speed, 0, 0], w=[0, speed / (0.5 * UNIT), 0], mu=1.0)
        ran = run(at, f"{count} facets at 1 m/s", [put, floor()], 1.0)
        lost = ran.energy()[0] - ran.energy()[-1]
        turned = abs(ran.place("can")[-1, 0]) / (2 * pi * 0.5) * count
        # A polygon of k^2 = 1/2 with inelastic impacts keeps (1/2 + cos(2 pi / N)) / (3/2) of its speed at each facet:
        # about the next corner that hits, its angular momentum is conserved.
        dead = 1 - (1 - 2 / 3 * (1 - cos(2 * pi / count))) ** (2 * turned + 4)
        rise = 9.81 * (0.5 - low) * UNIT / (0.75 * speed**2)
        yield ran.between("energy lost", 100 * lost / ran.kinetic()[0], -0.1, 100 * (dead + rise), "% of start")
        yield from ran.laws()
        slope = 0.5 * 180 / count
        put = Put("can", can, [0, 0, low], lie, mu=1.0)
        ran = run(at, f"{count} facets on {slope:.3g} degrees", [put, floor()], 2.0, tilt=slope)
        yield ran.most("moved", np.abs(ran.moved("can")[-1]).max(), 0.01, "sizes")
    put = Put("ball", at.mesh("ball", 0.5, 2), [0, 0, 0.5], v=[1, 0, 0], w=[0, 1 / (0.5 * UNIT), 0], mu=1.0)
    ran = run(at, "icosphere at 1 m/s", [put, floor()], 2.0)
    yield ran.most("energy", 100 * ran.kinetic()[-1] / ran.kinetic()[0], 100.1, "% of start")
    yield from ran.laws()


def round_on_meshes(at: Setting) -> Iterator[Check]:
    """Balls and capsules on meshes: at rest the gap is below 0.2 % of the smaller body, and nothing pushes before
    contact."""

    def gap(ran: Ran, under: Sequence[str], one: str, frame: int, smaller: float) -> Check:
        apart = max(ran.gap(name, one, frame) for name in under)
        return ran.between("gap", 100 * apart / smaller, -1.0, 0.2, "% of the smaller body")

    unders = {
        "slab": (at.mesh("box", 8, 8, 0.4), 0.2, 0.4),
        "cube": (at.mesh("box", 2, 2, 2), 1.0, 2.0),
        "icosphere": (at.mesh("ball", 1.0, 4), 1.0, 2.0),
    }
    for name, (shape, top, thick) in unders.items():
        under = fixed("under", shape, [0, 0, 0])
        for radius in (0.05, 0.25, 1.0, 2.0):
            # From the top of the icosphere a small ball rolls off, along its surface.
            low = top if name != "icosphere" else float(shape.mesh.vertices[:, 2].max())
            ball = Put("ball", solid("analytic", "ball", radius), [0, 0, low + 1.02 * radius], mu=1.0)
            ran = run(at, f"ball of radius {radius:g} on a {name}", [under, ball], 0.5)
            yield gap(ran, ["under"], "ball", ran.when(0.4), min(2 * radius, thick))
            yield from ran.laws()
    capsule = Put("it", solid("analytic", "capsule", 0.3, 2.0), [0.3, 0.2, 0.51], about("y", 90))
    ran = run(at, "capsule on a slab", [fixed("under", unders["slab"][0], [0, 0, 0]), capsule], 0.5)
    yield gap(ran, ["under"], "it", -1, 0.4)
    yield from ran.laws()
    # A groove of two boxes at right angles, open upwards: a ball of radius r touches both when its centre is r sqrt 2
    # above the edge where their faces meet.
    wall, radius = at.mesh("box", 4, 4, 4), 0.5
    walls = [fixed(f"wall {side}", wall, [side * 2 * sqrt(2), 0, 0], about("y", 45)) for side in (-1, 1)]
    ball = Put("ball", solid("analytic", "ball", radius), [0, 0.1, radius * sqrt(2) + 0.02])
    ran = run(at, "ball in a groove", [*walls, ball], 0.6)
    yield gap(ran, ["wall -1", "wall 1"], "ball", -1, 2 * radius)
    yield from ran.laws()


def flat_drops(at: Setting) -> Iterator[Check]:
    """Bodies that are dropped flat land flat."""
    forms = {"brick": (2, 1.5, 0.3), "plate": (3, 3, 0.1), "cube": (1, 1, 1)}
    grounds = {
        "plane": floor(),
        "box": fixed("box", solid("analytic", "box", 10, 10, 1), [0, 0, -0.5]),
        "mesh": fixed("mesh", solid("mesh", "box", 10, 10, 1), [0, 0, -0.5]),
    }
    if not at.full:
        del grounds["mesh" if at.kind == "analytic" else "box"]
    for name, size in forms.items():
        shape = at.box(*size)
        for under, ground in grounds.items():
            for e in (0.0, 0.3, 0.6):
                put = Put("it", shape, [0.13, 0.07, 1 + size[2] / 2], e=e)
                ran = run(at, f"{name} dropped on a {under}, e = {e:g}", [put, ground], 1.0)
                yield ran.most("tilt", ran.tilt("it").max(), 0.1, "degrees")
                yield ran.most("spin", np.abs(ran.w("it")).max(), 0.05, "rad/s")
                yield ran.most("aside", np.abs(ran.moved("it"))[:, :2].max(), 0.005, "sizes")
                yield from ran.laws()


def slabs(at: Setting) -> Iterator[Check]:
    """A sliding slab does not turn: the centre of pressure lies ahead, on the line of motion."""
    forms = {"2:1:0.3": (2, 1, 0.3), "1:1:0.1": (1, 1, 0.1), "4:1:0.2": (4, 1, 0.2)}
    grounds = {"plane": floor(), "box": fixed("box", at.box(40, 20, 1), [10, 0, -0.5])}
    for name, size in forms.items():
        for under, ground in grounds.items():
            for yaw in (0, 20, 45):
                put = Put("it", at.box(*size), [0, 0, size[2] / 2], about("z", yaw), v=[2, 0, 0], mu=0.3)
                ran = run(at, f"slab {name}, yaw {yaw}, on a {under}", [put, ground], 1)
                yield ran.most("turned", np.degrees(np.abs(ran.turned("it"))).max(), 1.0, "degrees")
                yield ran.slid("it", put, 0.02)
                yield from ran.laws()


def spins(at: Setting) -> Iterator[Check]:
    """Spin about the vertical stops after w I / (mu m g R) if all contact is at the distance R from the axis. For
    filled faces the distance is between that for even pressure (2/3 R for a disc, 0.3826 a for a square of side a, L/4
    for a thin bar) and the rim's."""
    mu, w = 0.3, 10.0

    def arm(label: str, shape: Shape, height: float, low: float, high: float) -> Iterator[Check]:
        inertia, mass = shape.inertia[2, 2], shape.volume
        ran = run(at, label, [Put("it", shape, [0, 0, height], w=[0, 0, w], mu=mu), floor()], 2.5)
        spin = np.abs(ran.w("it")[:, 2])
        over = np.flatnonzero(spin < 0.02 * w)
        at_s = inf
        if len(over):  # interpolated linearly between the spins of two frames
            k = int(over[0])
            share = (spin[k - 1] - 0.02 * w) / (spin[k - 1] - spin[k])
            at_s = float(ran.seconds[k - 1] + share * (ran.seconds[k] - ran.seconds[k - 1]))
        # The arm R that gives this time: w I UNIT^2 / (mu m g t).
        yield ran.between("arm", w * 0.98 * inertia / mass * UNIT**2 / (mu * G * at_s) / UNIT, low, high, "sizes")
        yield from ran.laws()

    # A leg's foot is a square of 0.08: its four corners and its middle are 0.371 to 0.452 from the axis, 0.41 +- 0.013
    # on average under even pressure.
    for legs in (3, 4):
        yield from arm(f"stool of {legs} legs", at.mesh("stool", legs), LEG[2], 0.41 * 0.94, 0.41 * 1.06)
    yield from arm("tube", at.mesh("tube", 0.5, 0.46, 0.5), 0.25, 0.48 * 0.95, 0.48 * 1.05)
    yield from arm("ring", at.mesh("torus", 0.5, 0.1), 0.1, 0.5 * 0.95, 0.5 * 1.05)
    yield from arm("disc", at.cylinder(0.5, 0.3), 0.15, 0.98 * 2 / 3 * 0.5, 1.02 * 0.5)
    yield from arm("square", at.box(1, 1, 0.3), 0.15, 0.98 * 0.3826, 1.02 * sqrt(0.5))
    yield from arm("bar", at.box(2, 0.1, 0.1), 0.05, 0.98 * 0.5, 1.02 * 1.0)


def gentle(at: Setting) -> Iterator[Check]:
    """Sleep changes nothing before forces are in balance: gentle slopes, turning points."""
    ball, cube = at.ball(0.5), at.box(1, 1, 1)

    def went(label: str, put: Put, pull: float, slope: float) -> Check:
        """Distance from its speed at the start, under a part `pull` of gravity along the slope."""
        ran = run(at, label, [put, floor()], 3.0, tilt=slope, sleep=True)
        t, a = ran.seconds[-1], pull * G * sin(radians(slope))
        return ran.near("way", ran.place(put.name)[-1, 0], (put.v[0] * t + 0.5 * a * t * t) / UNIT, 0.02, "sizes")

    if at.kind == "analytic":
        for slope in (0.05, 0.1, 0.5):
            yield went(f"ball down {slope:g} degrees", Put("ball", ball, [0, 0, 0.5], mu=1.0), 5 / 7, slope)
        for slope in (0.1, 0.3):
            speed = 0.5 * 5 / 7 * G * sin(radians(slope)) * 1.5  # turns after 0.75 s, and is back after 1.5 s
            put = Put("ball", ball, [0, 0, 0.5], v=[-speed, 0, 0], w=[0, -speed / (0.5 * UNIT), 0], mu=1.0)
            yield went(f"ball up {slope:g} degrees and back", put, 5 / 7, slope)
    for slope in (0.05, 0.2, 0.5):
        put = Put("cube", cube, [0, 0, 0.5], mu=0.0)
        yield went(f"cube without friction down {slope:g} degrees", put, 1.0, slope)
    put = Put("cube", cube, [0, 0, 0.5], mu=0.5)
    ran = run(at, "cube that friction holds", [put, floor()], 4.0, tilt=10.0, sleep=True)
    yield ran.most("moved", np.abs(ran.moved("cube")[-1]).max(), 1e-3, "sizes")


def edges(at: Setting) -> Iterator[Check]:
    """Cubes edge on edge, and edge on face: when they first touch. Each edge is sqrt(1/2) from its cube's centre."""
    cube = at.box(1, 1, 1)
    lower, upper = about("y", 45), about("x", 45)
    for place in ((0.0, 0.0), (0.125, 0.0), (0.125, -0.125), (0.31, 0.22)):
        # The lower edge runs along y, the upper along x; they cross at (0, y) and (x, 0).
        put = Put("upper", cube, [*place, 2 * sqrt(0.5) + 0.002], upper)
        # Soon after they touch, which is 6 ms after the start. An edge beside the middle then topples the cube about
        # the crossing, r aside of and sqrt(1/2) below its centre, which keeps r^2 / (r^2 + 1/2 + 1/6) of its fall.
        ran = run(at, f"edge on edge at {place}", [fixed("lower", cube, [0, 0, 0], lower), put], 0.03)
        k = ran.when(0.02)
        since = ran.seconds[k] - sqrt(2 * 0.002 * UNIT / G)
        kept = place[0] ** 2 / (place[0] ** 2 + 1 / 2 + 1 / 6)
        sunk = kept * (sqrt(2 * G * 0.002 * UNIT) * since + 0.5 * G * since**2) / UNIT
        yield ran.near("height", ran.place("upper")[k, 2], sqrt(2) - sunk, 0.0, "sizes", 0.002)
        yield from ran.laws()
    ran = run(at, "edge on a plane", [floor(), Put("upper", cube, [0, 0, sqrt(0.5) + 0.002], upper)], 0.06)
    yield ran.near("height", ran.place("upper")[ran.when(0.05), 2], sqrt(0.5), 0.0, "sizes", 0.002)
    slab = fixed("slab", at.box(3, 3, 0.5), [0, 0, -0.25])
    ran = run(at, "edge on a face", [slab, Put("upper", cube, [0.2, 0.1, sqrt(0.5) + 0.002], upper)], 0.06)
    yield ran.near("height", ran.place("upper")[ran.when(0.05), 2], sqrt(0.5), 0.0, "sizes", 0.002)
    yield from ran.laws()


def elastic(at: Setting) -> Iterator[Check]:
    """Frictionless hits with e = 1 conserve energy, momentum and angular momentum."""
    rng = np.random.default_rng(3)
    forms = {"cube": (1, 1, 1), "stick": (3, 0.3, 0.3), "plate": (2, 2, 0.2), "brick": (2, 1, 0.5)}
    shapes = [at.box(*size) for size in forms.values()]
    count = 300 if at.full else 24
    change, push, turn = [], [], []
    for _ in range(count):
        two = [shapes[rng.integers(len(shapes))] for _ in range(2)]
        turns = Rotation.random(2, rng=rng)
        spins = rng.uniform(-5, 5, (2, 3))
        aside = rng.uniform(-0.5, 0.5, 2)
        bodies = [
            Put("a", two[0], [-1.9, 0, 0], turns[0], v=[1, 0, 0], w=spins[0], mu=0, e=1),
            Put("b", two[1], [1.9, *aside], turns[1], v=[-1, 0, 0], w=spins[1], mu=0, e=1),
        ]
        ran = run(at, "throw", bodies, 0.5, gravity=0.0)
        energy = ran.energy()
        momentum, angular = _momenta(ran)
        if np.abs(ran.v("a")[-1] - ran.v("a")[0]).max() < 1e-6:
            continue  # they missed
        change.append(energy[-1] / energy[0] - 1)
        push.append(np.abs(momentum[-1] - momentum[0]).max())
        turn.append(np.abs(angular[-1] - angular[0]).max())
    label = f"{count} throws"
    yield Check(f"{label}: hits", len(change), count / 4, count)
    missed = [inf]  # if no throw hits, nothing is known
    yield Check(f"{label}: energy on average", 100 * float(np.mean(change or missed)), -0.1, 0.1, "%")
    yield most(f"{label}: energy at worst", 100 * float(np.abs(change or missed).max()), 2.0, "%")
    yield most(f"{label}: momentum", max(push or missed), 1e-9)
    yield most(f"{label}: angular momentum", max(turn or missed), 1e-6)
    if at.full:
        wall, leans = solid("analytic", "box", 20, 20, 2), (about("y", 90), about("x", 90), STILL)
        walls = [
            fixed(f"wall {axis} {side}", wall, 7.0 * side * np.eye(3)[axis], leans[axis])
            for axis in range(3)
            for side in (-1, 1)
        ]
        grid = [(x, y, z) for x in (-4.5, -1.5, 1.5, 4.5) for y in (-4.5, -1.5, 1.5, 4.5) for z in (-4, 0, 4)]
        gas = [
            Put(f"box {k}", shapes[0], place, Rotation.random(rng=rng), v=rng.uniform(-1, 1, 3), mu=0, e=1)
            for k, place in enumerate(grid)
        ]
        ran = run(at, "48 boxes in a closed box for 10 s", [*gas, *walls], 10.0, gravity=0.0)
        yield ran.near("energy", 100 * ran.energy()[-1] / ran.energy()[0], 100.0, 0.05, "% of start")
        yield ran.most("farthest centre", max(float(np.abs(ran.place(p.name)).max()) for p in gas), 6.0, "sizes")


def _momenta(ran: Ran) -> tuple[np.ndarray, np.ndarray]:
    """[T+1, 3] momentum and angular momentum about the origin, relative to the sum of the two bodies' magnitudes at the
    start."""
    push, turn = np.zeros((len(ran.time), 3)), np.zeros((len(ran.time), 3))
    had, had_turn = 0.0, 0.0
    for k, body in enumerate(ran.scene.bodies):
        shape, r = ran.scene.shapes[body.shape], ran.rollout
        inertia = shape.inertia * (body.mass / shape.volume * body.scale**2)
        axes = Rotation.from_quat(r.orientation[:, k])
        spin = axes.apply(axes.inv().apply(r.angular_velocity[:, k]) @ inertia)
        p = body.mass * r.velocity[:, k]
        arm = np.cross(r.position[:, k], p)
        push, turn = push + p, turn + spin + arm
        had += float(np.linalg.norm(p[0]))
        had_turn += float(np.linalg.norm(spin[0]) + np.linalg.norm(arm[0]))
    return push / had, turn / had_turn


def bullets(at: Setting) -> Iterator[Check]:
    """Small turned cubes against a plate of a sixth of their size: none passes."""
    rng = np.random.default_rng(4)
    cube = at.box(0.12, 0.12, 0.12)
    plate = solid("mesh" if at.kind == "grid" else at.kind, "box", 6, 6, 0.02)
    count = 36 if at.full else 12
    for speed in (20.0, 50.0, 200.0):
        for name, tilt in (("level", STILL), ("tilted", about("x", 20) * about("y", 10))):
            fly = []
            for k in range(count):
                place = [0.8 * (k % 6 - 2.5), 0.8 * (k // 6 - 0.5), 2.5]
                fly.append(Put(f"it {k}", cube, place, Rotation.random(rng=rng), v=[0, 0, -speed], e=0.3))
            label = f"cubes at {speed:g} m/s on a {name} plate"
            ran = run(at, label, [fixed("plate", plate, [0, 0, 0], tilt), *fly], 0.5 / speed * 2)
            normal = tilt.apply([0.0, 0.0, 1.0])
            through = sum(bool((ran.place(p.name)[-1] @ normal) < -0.01) for p in fly)
            yield ran.most(f"passed of {count}", through, 0)


def before_touch(at: Setting) -> Iterator[Check]:
    """Nothing is pushed before it touches."""
    small, large = at.mesh("ball", 1.0, 4), solid("analytic", "ball", 2.1)
    bodies = [fixed("small", small, [0, 0, 0]), Put("large", large, [-3.6, 0, 0], v=[0.2, 0, 0], mu=0.0)]
    ran = run(at, "ball on a mesh ball", bodies, 0.6, gravity=0.0)
    # A frictionless ball without restitution stops when it hits a fixed one centrally. The nearest corner of the mesh
    # is up to 0.05 rad aside, which leaves 0.01 m/s, and the same again at the next corner.
    yield ran.most("speed after", float(np.linalg.norm(ran.v("large")[-1])), 0.015, "m/s")
    yield from ran.laws()
    ring = at.mesh("torus", 0.5, 0.1)  # a hole of radius 0.4
    rod = fixed("rod", solid("analytic", "capsule", 0.32, 20.0), [0, 0, 0])
    ran = run(at, "ring around a rod with clearance", [rod, Put("ring", ring, [0, 0, 5.0])], 0.2)
    wanted = 0.5 * G * ran.seconds[-1] ** 2 / UNIT
    yield ran.near("fall", 5.0 - ran.place("ring")[-1, 2], wanted, 0.01, "sizes")
    yield from ran.laws()


EVERYDAY = (
    slender, heaps, seams, thin_floors, rolling, facets, round_on_meshes, flat_drops, slabs, spins, gentle, edges,
    elastic, bullets, before_touch,
)  # fmt: skip
