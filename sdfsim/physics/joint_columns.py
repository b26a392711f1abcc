"""Columns of the arrays of joints, for the compiled step and all other code."""

KINDS = ("hinge", "slider", "ball", "fixed", "distance")
HINGE, SLIDER, BALL, FIXED, DISTANCE = range(5)
# Columns of `Joints.number`: limits, restitution there, friction and damping, spring, motor (see the modes), its
# largest force or torque, time and gain (0: as much as its strength allows), length of the rod (below 0: none),
# breaking loads, and armature.
(
    LOW, HIGH, BOUNCE, DAMPING, FRICTION, STIFFNESS, REST, MOTOR, MAX_FORCE, TIME, GAIN, LENGTH, FORCE, TORQUE,
    ARMATURE, NUMBERS,
) = range(16)  # fmt: skip
# Columns of `State.joints`: the joint's angle, position or length, its speed, the target of its motor, whether it is
# broken; force and torque on the first body (at its anchor, world axes); the impulses at its limit, and of motor and
# friction, of the last inner step (a ball has three of the latter; after the impulse of a motor with friction comes
# that of the motor alone); how much its rows have to turn in an inner step so that they hold at its end; the work of
# the motor in the step; the impulse of the coupling in which it follows another joint.
COORD, SPEED, TARGET, BROKEN, PULL, TWIST, STOP, DRIVE, CURVE, GIVEN, TIE, STATE = (
    0, 1, 2, 3, 4, 7, 10, 11, 14, 20, 21, 22,
)  # fmt: skip
NOTHING, TO_SPEED, TO_PLACE = range(3)  # modes of a motor
