"""All tolerances of the contact solve, each with its unit and its reason.

Model lengths and speeds are in units in which the smallest bodies of a scene are about 1.4 wide and gravity is 10 (see
`physics.units`). Cells are those of a grid, slops the penetration that is not resolved. What has no unit is a ratio, a
cosine or a number of rounds. Sizes of arrays stand beside the arrays.
"""

from __future__ import annotations

from typing import NamedTuple

from sdfsim.physics.options import Options

# --- Contacts: when bodies touch, and what friction and rebounds are.

# Penetration that is not resolved, so that contacts of bodies at rest persist: at most SLOP model lengths, and less in
# inner steps shorter than the usual 4 ms, which scenes of slender bodies have: SLOP_A_TIME times the inner step.
SLOP, SLOP_A_TIME = 1e-4, 0.025
SLOW = 2.0  # inner steps: an approach no faster than what gravity gives in this time ends without a rebound
ROUNDS = 100  # largest number of sweeps of sequential impulses in an inner step
MET = 1e-6  # model lengths: nearer is touching, so that rounding does not decide when bodies in contact meet
REPORTED = 1e-3  # model lengths: nearer points are reported as contacts
TOGETHER = 0.01  # relative, squared: angular velocities that differ by less are those of bodies that turn together
NO_SLIP = 1e-9  # squared speed: slower tangential motion has no direction
NO_PULL = 1e-6  # likewise of gravity along a surface, squared, relative to all of it
# Bodies that approach by more than this part of their thickness in an inner step rebound before they have touched, else
# after: thin bodies would overlap deeply.
THIN_EARLY = 0.005
THIN_FAR = 0.4  # relative to a wall: motion in an inner step beyond which a body is checked on its way
THIN_IN = 0.75  # part of the depth to which it may go in that check, as the search comes near it, but not to it
ON_ITS_WAY = 64  # rounds of that search


class Rules(NamedTuple):
    """Options of a run, and the tolerances that depend on them, in model lengths and speeds."""

    options: Options
    substep_dt: float  # the inner step
    slow: float  # an approach up to this speed ends at the surface without a rebound
    ahead: float = 0.0  # time: new points are searched as much farther as two bodies approach each other in it
    contact_margin: float = 0.02  # contacts are kept up to this distance, and until they have slid by more
    search_margin: float = 0.006  # new ones are searched up to this distance
    still: float = 1e-4  # pairs that have moved by less within a step are not tested again
    erp: float = 0.2  # share of a penetration that an inner step resolves
    slop: float = SLOP  # penetration that is not resolved
    rounds: int = ROUNDS  # largest number of sweeps of sequential impulses
    exact: float = 2e-5  # sweeps end when no impulse changes a velocity by more
    apart: float = 0.03  # least distance of points of a manifold from each other
    # stray, rest: a body that stays within `stray` for `rest` steps falls asleep, if its forces are so nearly in
    # balance that they would move it by less than `drift` in the same time
    stray: float = 0.005
    rest: int = 25
    drift: float = 2e-4


# --- Impulses.

ENERGY_GAIN = 1e-4  # part of the energy with which contacts meet: an impact gains energy if it gains more
# The larger the ratio of masses, the more slowly sweeps carry a load to lighter bodies. The number of sweeps of an
# island is multiplied by its ratio divided by the first number, at most by the second.
EVEN_MASSES, MOST_OFTEN = 30.0, 30.0
EVENED = 0.2  # share of the difference to their mean that impulses of a face lose before each inner step, beside joints
JOINTS_EXACT = 0.01  # relative to the precision to which contacts without joints are solved
END_EXACT = 0.1  # likewise at the end of a step, whose velocities users see
MANY_ISLANDS = 64  # number of islands from which threads pay off
MANY_PAIRS = 192  # number of pairs from which threads pay off, even beside other programs
CROWD = 64  # number of dynamic bodies from which threads may test pairs

# --- Joints.

STRETCH = 1e-7  # model lengths (and rad): rows with a larger error are repaired by moving bodies
REPAIR = 0.05  # largest repair in an inner step, model lengths (and rad)
LIMIT_GIVES = 0.2  # share of an overrun limit that an inner step resolves
LIMIT_AHEAD = 0.05  # model lengths (and rad): nearer limits are taken into account
HOLDS = 1e-11  # model lengths (and rad): rows of joints need not hold more exactly
TRIALS = 6  # rounds of the search for impulses after which rows hold
BREAKS = 4  # rounds in which joints may break in one inner step
# Relative to its effect without joints: if the effect of a bounded row is less, joints allow no motion along it, and
# what is left is rounding. The joints then bear all of it.
BLOCKED = 1e-7
LOCKED = 1e-9  # relative to its joints alone: a coupling with less effect can move nothing
# (Phase of a spring in an inner step)^2 up to which it is not damped: ten inner steps a period.
RESOLVED = 0.4
RIGID = 1e-9  # least impulse of a spring for a unit of speed, relative to the row's effective mass
REDUNDANT = 1e-10  # relative to the effect of a unit impulse along a row: makes redundant rows solvable
NO_SWING = 1e-9  # sine of the angle of a ball joint below which its axis has no direction
NO_LENGTH = 1e-12  # model lengths: a shorter distance joint has no direction
MOST_TURN, MOST_TURNS = 0.1, 1000  # rad in one stage of torque-free rotation, and the number of stages

# --- Convex solids: the least distance of two, and where their faces touch.

TOO_NEAR = 1e-4  # relative to the thickness: nearer solids are moved apart first, as rounding would turn their normals
PUT_APART = 1e-3  # relative to the thickness: overlapping solids are moved this far apart
# Cosine between a normal and that of a face, above which the face's is taken; and, relative to the thickness, the
# difference of depth at which two normals count as equally good.
ALONG_FACE, AS_DEEP = 1.0 - 5e-6, 1e-9
GJK_EXACT = 1e-14  # relative precision of squared distances
GJK_ROUNDS, NORMAL_ROUNDS = 48, 16  # largest numbers of GJK steps, and of rounds for normals
FEW_VERTICES = 48  # vertices that are all tested; in larger hulls the search climbs from neighbour to neighbour
STEEP = 0.1  # cosine between a face's normal and the contact's, below which the face does not bound the contact
LEVEL_END = 1e-3  # slope of a drum's end relative to the normal, below which its circle is cut at fixed points
EDGES_ASIDE = 0.002  # relative to the thickness: edges touch along their length if they are no farther aside
EDGES_LEVEL = 1e-12  # relative to its length: how far from parallel edges count as parallel
EQUALLY_DEEP = 1e-4  # relative to the thickness: points whose depths differ by less count as equally deep
BULGE = 0.05  # relative to a small face: how far a circle may bulge beyond the points on it that bound the face
ONE_POINT = 1e-4  # relative to the contact's extent: nearer points are one
# Relative to the contact's extent and to the gap: if all corners are higher by more, edges meet between them.
BETWEEN_CORNERS, BETWEEN_GAPS = 1e-6, 1e-9
IN_FACE = 1e-3  # relative to the contact's extent: points that are no higher above the deepest press as one face
NO_AREA = 1e-6  # relative to the extent squared: a face with less is an edge
SAME_LENGTH = 1e-9  # relative: lengths that differ by less are equal, so that rounding does not choose between points

# --- Manifolds: which points are one, and which are kept.

ALIKE = 0.9  # cosine between normals, above which they count as equal
SAME_NORMAL, SAME_CORE = (
    0.8,
    0.99,
)  # likewise of an old and a new point in one place, and of one anywhere on a round body
EQUAL = 1e-9  # model lengths, or their squares: they count as equal if they differ by less
ONE_FACE = 0.02  # squared difference of normals, up to which points bound one face
TURN_COUNTS = 0.01  # squared model lengths that a squared difference of normals is worth, when points are spread
OUTWARD = 1e-3  # how much deeper a point must be to be preferred to one that is farther out by one length
FLAT = 0.95  # least cosine between the normals of one face
# Mean distance of a face's points from its middle, relative to that of its corners: 0.54 for a square, 0.67 for a disc,
# 0.5 for a bar.
FACE_ARM = 0.58
ARM_PROBES = 12  # probes on the way from the middle of a face to its corner

# --- Surfaces: distances of grids and triangles, and the descent along a surface to the nearest point.

NO_SLOPE = 1e-12  # slope of a distance below which it has no direction
GRID_CLOSE = 2.0  # cells: a grid is exact enough farther from the surface
GRID_OFF = 1.5  # relative to a grid's error: how far beyond the grid's distance triangles are searched
GRID_FINE = 2.0  # cells: a grid is fine within this distance of its surface
GRID_FARTHER = 2.0  # cells: elsewhere its distance may be too large by this much, at a tip
FIRST_FACE = 1e-9  # relative to the size: on an edge of a closed form the first face gives the normal, not rounding
ON_FEATURE = 1e-9  # relative to the solid's size: nearer to a feature its pseudonormal is the normal
DESCENT_ROUNDS = 12  # rounds of refinement
FIRST_STRIDE, LAST_STRIDE = 0.02, 5e-4  # first and last step of the refinement, relative to a body's size
LEVEL_SLOPE = 0.02  # slope of the distance along a surface below which the refinement has arrived
LONGER = 4.0  # a step is at most this many times the last one
SHORTER, SHORTEST = 0.4, 0.1  # a step that led nowhere is shortened by a factor between these
LOWER = 1e-9  # least gain of a step, in the other shape's lengths
ONTO, BESIDE = 3, 0.05  # number of steps back onto the body's own surface, and how near, in strides, they must get
ONTO_IT = 0.05  # cells: a point this near a surface is on it
RESTART, MOVED_SINCE = 2.5, 4.0  # first step when starting again: least multiples of the last, and of the motion since
PROBED = 0.01  # cells: a body that has moved by more may have rolled over a ripple of its grid
WITHIN = 0.5  # cells: how far the refinement on a grid may end from where triangles are nearest
SHARP_ROUNDS, SHARP_STRIDE = (
    4,
    1e-4,
)  # rounds of refinement on triangles, and their last step, relative to a body's size
SHARP_REACH = 1.01  # of a step along a normal: how far from there triangles are searched
SHARP_SHORTER = 0.2  # a step that led nowhere becomes at least this much shorter
LEVEL_FACE = 0.1  # slope below which steps along triangles are too short, and their corners are compared
TRACED_TO, TRACE_ROUNDS = (
    1e-6,
    12,
)  # model lengths: farther points do not touch yet; and steps of a search along their way
CORE_ENDS = 0.95  # of a core's half length: a nearest point farther out is that of the end
LEVEL_CIRCLE = 1e-9  # relative to a circle's radius: differences of distance that show no nearest point

# --- Internal edges: surfaces of several bodies, pieces or triangles.

ASLANT = 0.9999  # cosine between a normal and that of a support, above which the two count as equal
FACING = -0.1  # cosine below which they face each other
# slops: what rises above a support by no more than this is no wall; a contact that is deeper than this always acts
LEVEL = 4.0
AROUND = 12.0  # slops: distance from a contact within which triangles may be its wall

# --- Checks when a scene is prepared.

# Places at which triangles and grid are compared, and the part that must be on one side.
SIDED, AGREED = 4000, 0.98
