"""Columns of the arrays of joints, for the compiled step and all other code."""

KINDS = ("hinge", "slider", "ball", "fixed", "distance")
HINGE, SLIDER, BALL, FIXED, DISTANCE = range(5)
# Columns of `Joints.number`: limits, restitution there, friction and damping, spring, motor (0: none, 1: to a speed, 2:
# to a place), its strength, time and gain (0: as much as its strength allows), length of the rod (below 0: none), and
# breaking loads.
LOW, HIGH, BOUNCE, DAMPING, DRAG, STIFFNESS, REST, MOTOR, MOST, TIME, GAIN, LENGTH, FORCE, TORQUE, NUMBERS = range(15)
# Columns of `State.joints`: the joint's angle, position or length, its speed, the target of its motor, whether it is
# broken, whether its impulses are unknown; force and torque on the first body (at its anchor, world axes); the impulses
# at its limit, of motor and friction, and of spring and damping, all of the last inner step (a ball has three of each
# of the last two; after the impulse of a motor with friction comes that of the motor alone); how much its rows have to
# turn in an inner step so that they hold at its end; the work of the motor in the step.
COORD, SPEED, TARGET, BROKEN, FRESH, PULL, TWIST, STOP, DRIVE, SOFT, BEND, GIVEN, STATE = (
    0, 1, 2, 3, 4, 5, 8, 11, 12, 15, 18, 24, 25,
)  # fmt: skip
NOTHING, TO_SPEED, TO_PLACE = range(3)  # modes of a motor
