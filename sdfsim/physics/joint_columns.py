"""Columns of the arrays that joints are kept in, by the compiled step and by all else."""

KINDS = ("hinge", "slider", "ball", "fixed", "distance")
HINGE, SLIDER, BALL, FIXED, DISTANCE = range(5)
# Columns of `Joints.number`: where a joint ends, how it rebounds there, what drags, pulls and drives it (0: nothing, 1:
# to a speed, 2: to a place), how long its rod is (below 0: it has none), and what it bears.
LOW, HIGH, BOUNCE, DAMPING, DRAG, STIFFNESS, REST, MOTOR, MOST, TIME, LENGTH, FORCE, TORQUE, NUMBERS = range(14)
# Columns of `State.joints`: its angle, position or length, how fast that changes, what its motor aims at, whether it is
# broken, whether nothing is known of its impulses; force and torque on the first body (at its anchor, world axes), the
# impulses at its limit, of its motor and friction, of its spring and damping, all of the last inner step (a ball has
# three of the latter two; behind the one of a motor with friction stands that of the motor alone); by how much its rows
# have to turn in an inner step so that they hold at its end; what the motor has given in the step.
COORD, SPEED, TARGET, BROKEN, FRESH, PULL, TWIST, STOP, DRIVE, SOFT, BEND, GIVEN, STATE = (
    0, 1, 2, 3, 4, 5, 8, 11, 12, 15, 18, 24, 25,
)  # fmt: skip
NOTHING, TO_SPEED, TO_PLACE = range(3)  # what a motor does
