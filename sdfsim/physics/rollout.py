"""A finished (or partial) simulation as arrays, and its file."""

import json
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, write_arrays


@dataclass(frozen=True)
class Rollout:
    """T steps of N bodies; entry 0 of every array is the initial state.

    Attributes:
        time: [T+1] s.
        position: [T+1, N, 3] float64 m, centres of mass.
        orientation: [T+1, N, 4] float64 xyzw, shape axes -> world.
        velocity: [T+1, N, 3] m/s.
        angular_velocity: [T+1, N, 3] rad/s, world frame.
        contact_count: [T+1] int64, number of contacts that acted in the step that led here.
        contact_point: [sum(contact_count), 3] float64 m, world, in step order: the points of their owners at which
            contacts acted, with the bodies as they are in this entry.
        contact_body: [sum(contact_count), 2] int64, (owner of the node, body it meets).
        contact_force: [sum(contact_count), 3] N, world, on the owner, the mean in the last inner step; NaN where it is
            not known: only `Simulator.record` keeps it.
        counters: name -> [T+1] array: `kinetic_energy` J, `potential_energy` J, `energy_given` J (by pulls, pushes and
            changes of the state, since the frame before), `contacts`, `worst_penetration` m, `step_ms`, and other
            counts of the simulator. The penetration is the depth of the deepest of an entry's contact points within the
            body that it meets, by that body's distances; 0 if none is inside.
        names: N body names.
        joint_names: J names of joints; empty if joints are off.
        joint_position: [T+1, J] the angle of hinges and balls in rad, the position of sliders and the length of
            distances in m, 0 for fixed joints; joint_velocity: [T+1, J] the rates at which they change.
        joint_effort: [T+1, J] N m or N, of the joints' motors in the last inner step; NaN as for `contact_force`.
        joint_force: [T+1, J, 3] N, world, on the joint's first body in the last inner step; joint_torque: [T+1, J, 3]
            N m, about the joint's anchor.
        meta: model, seed, versions, dt s.
    """

    time: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    contact_count: np.ndarray
    contact_point: np.ndarray
    contact_body: np.ndarray
    counters: dict[str, np.ndarray] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    meta: dict = field(default_factory=dict)
    joint_names: tuple[str, ...] = ()
    contact_force: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    joint_position: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    joint_velocity: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    joint_effort: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    joint_force: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    joint_torque: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))

    def __len__(self) -> int:
        """Number of steps, T."""
        return len(self.time) - 1

    def frames(self, start: int, stop: int) -> "Rollout":
        """Entries `start` to `stop` (exclusive) of every array, contacts included."""
        ends = np.concatenate([[0], np.cumsum(self.contact_count)])
        rows = slice(int(ends[start]), int(ends[stop]))
        cut = slice(start, stop)
        return replace(
            self,
            **{f: getattr(self, f)[cut] for f in _PER_FRAME},
            contact_point=self.contact_point[rows],
            contact_body=self.contact_body[rows],
            contact_force=self.contact_force[rows],
            counters={k: v[cut] for k, v in self.counters.items()},
        )

    def save(self, path: Path | str) -> None:
        """Write `rollout.npz`."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("counters", "names", "meta")}
        if self.joint_names:
            arrays["joint_names"] = np.array(self.joint_names, dtype=str)
        else:
            arrays = {name: value for name, value in arrays.items() if not name.startswith("joint_")}
        arrays |= {f"counter_{k}": v for k, v in self.counters.items()}
        arrays |= {"names": np.array(self.names, dtype=str), "meta": np.array(json.dumps(self.meta))}
        write_arrays(Path(path), arrays)

    @classmethod
    def load(cls, path: Path | str) -> "Rollout":
        """Read a `rollout.npz`. Raises SdfsimError if it is missing or not one of ours."""
        arrays = read_arrays(Path(path), "a rollout", "give a run folder, or the rollout.npz in it")
        try:
            counters = {k.removeprefix("counter_"): arrays.pop(k) for k in list(arrays) if k.startswith("counter_")}
            names = tuple(str(n) for n in arrays.pop("names"))
            joints = tuple(str(n) for n in arrays.pop("joint_names", ()))
            meta = json.loads(str(arrays.pop("meta")))
            return cls(**arrays, counters=counters, names=names, meta=meta, joint_names=joints)
        except (KeyError, TypeError, ValueError) as error:
            raise SdfsimError(f"{path}: not a rollout of sdfsim ({error})") from error


_PER_FRAME = (
    "time", "position", "orientation", "velocity", "angular_velocity", "contact_count", "joint_position",
    "joint_velocity", "joint_effort", "joint_force", "joint_torque",
)  # fmt: skip
_PER_CONTACT = ("contact_point", "contact_body", "contact_force")


def join(frames: list[Rollout]) -> Rollout:
    """One rollout from consecutive pieces."""
    return replace(
        frames[0],
        **{k: np.concatenate([getattr(f, k) for f in frames]) for k in (*_PER_FRAME, *_PER_CONTACT)},
        counters={k: np.concatenate([f.counters[k] for f in frames]) for k in frames[0].counters},
    )
