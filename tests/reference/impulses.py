"""What contacts do to velocities in one inner step, in NumPy and loops, to be read: the oracle of the compiled solve.

Sequential impulses (Catto 2005) on bodies of velocity v and angular velocity w. A contact at arms r and q from the two
centres, with the normal n from the second body to the first, sees the relative velocity u = v1 + w1 x r - v2 - w2 x q.
An impulse j along an axis d changes it along d by j / m, with 1 / m = 1 / m1 + 1 / m2 + (r x d) . I1^-1 (r x d) +
(q x d) . I2^-1 (q x d). Contacts of an island are swept in turn: normals, which only push, then friction in its cone.
"""

from dataclasses import dataclass, field

import numpy as np

TOUCH = 1e-6  # model lengths: nearer is touching
EARLY = 0.005  # of the thinner wall: what comes nearer in an inner step rebounds before it has touched


@dataclass
class Body:
    """A body in an inner step, in the world's axes."""

    position: np.ndarray  # [3]
    velocity: np.ndarray  # [3]
    angular: np.ndarray  # [3]
    inverse_mass: float
    inverse_inertia: np.ndarray  # [3, 3]
    falls: np.ndarray  # [3] what gravity and pulls add to the velocity in the step
    spins: np.ndarray  # [3] likewise to the angular one
    turns: np.ndarray  # [3] and what the gyroscopic torque adds to it
    restitution: float
    thickness: float
    change: np.ndarray = field(default_factory=lambda: np.zeros(6))  # what contacts add to both velocities
    shift: np.ndarray = field(default_factory=lambda: np.zeros(6))  # and for this step only, to part the bodies


@dataclass
class Contact:
    """A point of contact. Of a face, friction acts nearer to the middle: at the arms of `rubs`."""

    bodies: tuple[Body, Body]
    arms: tuple[np.ndarray, np.ndarray]  # from the centres to where it is on either, world axes
    rubs: tuple[np.ndarray, np.ndarray]
    normal: np.ndarray  # [3] from the second to the first
    gap: float
    push: float  # impulse of the step before, along the normal
    drag: np.ndarray  # [3] and across it
    void: bool
    friction: float
    rows: "list[Row]" = field(default_factory=list)  # along the normal and two tangents, where it acts
    deep: float = 0.0  # speed that parts what is in each other
    parted: float = 0.0  # its impulse so far
    calm: float = 0.0  # the change along the normal that is wanted if nothing rebounds
    before: float = 0.0  # speed along the normal without contact


@dataclass
class Row:
    """One direction of a contact, and the change of velocity along it that is wanted."""

    bodies: tuple[Body, Body]
    arms: tuple[np.ndarray, np.ndarray]
    axis: np.ndarray
    wanted: float = 0.0
    impulse: float = 0.0

    def __post_init__(self) -> None:
        self.levers = np.cross(self.arms[0], self.axis), -np.cross(self.arms[1], self.axis)
        both = zip(self.bodies, self.levers, strict=True)
        self.mass = 1.0 / sum(b.inverse_mass + lever @ b.inverse_inertia @ lever for b, lever in both)

    def speed(self, of: str = "change") -> float:
        """What the contacts' change of velocities makes along the row."""
        one, two = (getattr(b, of) for b in self.bodies)
        return self.axis @ (one[:3] - two[:3]) + self.levers[0] @ one[3:] + self.levers[1] @ two[3:]

    def give(self, impulse: float, of: str = "change") -> None:
        for body, lever, sign in zip(self.bodies, self.levers, (1.0, -1.0), strict=True):
            getattr(body, of)[:3] += sign * impulse * body.inverse_mass * self.axis
            getattr(body, of)[3:] += impulse * body.inverse_inertia @ lever

    def bring(self, least: float, most: float) -> float:
        """Towards the wanted velocity, as far as limits of the impulse allow; by how much that changed it."""
        total = min(max(self.impulse + (self.wanted - self.speed()) * self.mass, least), most)
        changed, self.impulse = total - self.impulse, total
        self.give(changed)
        return abs(changed) / self.mass


def met(bodies: tuple[Body, Body], arms: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Both places moved half way to one another: equal and opposite impulses at one place keep angular momentum."""
    apart = bodies[0].position + arms[0] - bodies[1].position - arms[1]
    return arms[0] - 0.5 * apart, arms[1] + 0.5 * apart


def relative(bodies: tuple[Body, Body], arms: tuple[np.ndarray, np.ndarray], what: str) -> np.ndarray:
    """Relative velocity at a contact: "now", "falling" (with what pulls) or "then" (and the gyroscopic torque)."""
    found = []
    for b, arm in zip(bodies, arms, strict=True):
        w = b.angular + (what != "now") * b.spins + (what == "then") * b.turns
        found.append(b.velocity + (what != "now") * b.falls + np.cross(w, arm))
    return found[0] - found[1]


def acts(c: Contact, rules) -> bool:
    """Write the equations of a contact; False where it does not act in this inner step."""
    bodies, n, arms = c.bodies, c.normal, met(c.bodies, c.arms)
    approach = relative(bodies, arms, "now") @ n
    falling, then = (relative(bodies, arms, what) for what in ("falling", "then"))
    gap = c.gap
    way = -(then @ n) * rules.substep_dt
    early = way > EARLY * min(b.thickness for b in bodies)
    later = -approach > rules.slow and not early  # it first touches, and rebounds in the inner step after
    if c.void or (gap > TOUCH and (gap > way or later)):
        return False
    e = bodies[0].restitution * bodies[1].restitution if rules.options.restitution else 0.0
    # Newton's rule, v' = -e v, at each contact of an impact; what rebounds early as fast as it will come back by here.
    target, rebounds = 0.0, False
    if e > 0.0 and abs(approach) > rules.slow:
        pull = early * max(gap, 0.0) * (falling @ n - approach) / rules.substep_dt
        square = (e * approach) ** 2 + 2.0 * pull * (1.0 - e * e)
        rebounds = square > 0.0
        target = -np.sign(approach) * np.sqrt(max(square, 0.0))
    c.before = (falling if rebounds else then) @ n
    rest = -gap / rules.substep_dt if gap > TOUCH else 0.0  # what is open comes up to the surface
    if gap > TOUCH:
        target = target if rebounds else rest
    else:
        c.deep = max(-gap - rules.slop, 0.0) * rules.erp / rules.substep_dt
        if 0.0 < -approach <= rules.slow and not rebounds:  # the surface turned inwards: along its chord
            target = rest = min(c.deep, -approach)
    c.calm = rest - c.before
    c.rows = [Row(bodies, arms, n, target - c.before, c.push)]
    if c.friction == 0.0:
        return True
    then = relative(bodies, arms := met(bodies, c.rubs), "then")
    slip = then - (then @ n) * n
    if slip @ slip < 1e-9:  # it has no direction
        slip = rules.options.gravity - (rules.options.gravity @ n) * n
        if slip @ slip < 1e-6 * (rules.options.gravity @ rules.options.gravity) + 1e-30:
            slip = np.cross(n, [1.0, 0.0, 0.0] if abs(n[0]) < 0.7 else [0.0, 1.0, 0.0])
    one = slip / np.linalg.norm(slip)
    c.rows += [Row(bodies, arms, t, -(then @ t), c.drag @ t) for t in (one, np.cross(n, one))]
    c.rows[1].impulse, c.rows[2].impulse = bounded(c, c.rows[1].impulse, c.rows[2].impulse)
    return True


def bounded(c: Contact, one: float, two: float) -> tuple[float, float]:
    """A tangential impulse within the cone of friction."""
    most = c.friction * c.rows[0].impulse
    length = np.hypot(one, two)
    return (one, two) if length <= most else (one * most / length, two * most / length)


def islands(contacts: list[Contact]) -> list[list[Contact]]:
    """Contacts that share bodies that move, in the order in which they are given."""
    groups: list[list[Contact]] = []
    for c in contacts:
        near = {id(b) for b in c.bodies if b.inverse_mass > 0.0}
        joined = [g for g in groups if any(id(b) in near for x in g for b in x.bodies)]
        groups = [g for g in groups if not any(g is x for x in joined)] + [[x for g in joined for x in g] + [c]]
    return [[c for c in contacts if any(c is x for x in group)] for group in groups]


def sweeps(island: list[Contact], rules) -> range:
    """As many more as masses are uneven."""
    masses = [b.inverse_mass for c in island for b in c.bodies if b.inverse_mass > 0.0]
    more = np.clip(max(masses) / min(masses) / 30.0, 1.0, 30.0)
    return range(int(rules.rounds * more))


def part(island: list[Contact], rules) -> None:
    """Velocities that move deep bodies out of each other once, and are forgotten."""
    for _ in sweeps(island, rules):
        worst = 0.0
        for c in (c for c in island if c.deep > 0.0):
            r = c.rows[0]
            lasts = max(c.before + r.speed(), 0.0)
            total = max(c.parted + (c.deep - lasts - r.speed("shift")) * r.mass, 0.0)
            r.give(total - c.parted, "shift")
            worst, c.parted = max(worst, abs(total - c.parted) / r.mass), total
        if worst <= rules.exact:
            return


def balance(island: list[Contact], rules) -> None:
    """Sweeps over all normals, then all friction, until none changes a velocity by more than `exact`."""
    for _ in sweeps(island, rules):
        worst = [c.rows[0].bring(0.0, np.inf) for c in island]
        worst += [rub(c) for c in island if len(c.rows) == 3]
        if max(worst) <= rules.exact:
            return


def rub(c: Contact) -> float:
    """One sweep of friction at a contact; by how much it changed a velocity."""
    one, two = c.rows[1:]
    mass = min(one.mass, two.mass)  # one for both: the impulse is against the slip
    tried = bounded(c, *(r.impulse + (r.wanted - r.speed()) * mass for r in (one, two)))
    changed = [total - r.impulse for r, total in zip((one, two), tried, strict=True)]
    for r, impulse in zip((one, two), changed, strict=True):
        r.give(impulse)
        r.impulse += impulse
    return max(map(abs, changed)) / mass


def gain(island: list[Contact]) -> float:
    """The work of contacts: impulses times mean velocities."""
    work = 0.0
    for c in island:
        work += c.rows[0].impulse * (c.before + 0.5 * c.rows[0].speed())
        work += sum(r.impulse * (0.5 * r.speed() - r.wanted) for r in c.rows[1:])
    return work


def keep_energy(island: list[Contact], rules) -> None:
    """If rebounds give energy, take as much of them as gives none: the energy is convex in the impulses."""
    more, known = gain(island), [r.impulse for c in island for r in c.rows]
    if more <= 1e-4 * sum(0.5 * c.rows[0].mass * c.before**2 for c in island):
        return
    for c in island:
        c.rows[0].wanted = c.calm
    balance(island, rules)
    less = gain(island)
    share = max(less / (less - more), 0.0) if less < more else 0.0
    for r, rebound in zip((r for c in island for r in c.rows), known, strict=True):
        changed = share * (rebound - r.impulse)
        r.impulse += changed
        r.give(changed)


def solve_contacts(contacts: list[Contact], rules) -> None:
    """Solve for all impulses: to `push` and `drag` of the contacts, and to `change` and `shift` of the bodies."""
    for c in contacts:
        if not acts(c, rules):
            c.push, c.drag = 0.0, np.zeros(3)
    for island in islands([c for c in contacts if c.rows]):
        for r in (r for c in island for r in c.rows):  # warm start
            r.give(r.impulse)
        balance(island, rules)
        if any(c.rows[0].wanted > c.calm for c in island):
            keep_energy(island, rules)
        part(island, rules)
        for c in island:
            c.push = c.rows[0].impulse
            c.drag = sum((r.impulse * r.axis for r in c.rows[1:]), np.zeros(3))
