"""Public recordings of real tosses by name: fetched once into the user's cache folder and checked by their SHA-256.

The DAIR Lab of the University of Pennsylvania (BSD 3-Clause) tossed both onto a table and tracked them at 148 Hz:
`contactnets-cube`, an acrylic cube, published with the code of ContactNets (Pfrommer, Halm and Posa 2020), and
`contactnets-elbow`, two printed links on a hinge, published with that of dair_pll (Bianchini, Halm and Posa 2023).
"""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import user_cache, write_arrays, write_text
from sdfsim.base.parallel import Progress, silent
from sdfsim.data.public_shapes import ARCHIVE, fetched

GITHUB = "https://codeload.github.com"
RATE = 148.0  # Hz
UNIT = 0.0524  # m: the unit of length in the cube's files is half a side


@dataclass(frozen=True)
class Tosses:
    """Where a set is published: files N.pt in a folder of one commit, so that they cannot change."""

    repository: str
    commit: str
    folder: str
    count: int
    checksum: str  # SHA-256 of all files, one after the other in the order of their numbers

    @property
    def url(self) -> str:
        return f"{GITHUB}/{self.repository}/tar.gz/{self.commit}"


SETS = {
    "contactnets-cube": Tosses(
        "DAIRLab/contact-nets", "c3dc21c94577ff4ed99123f0b00bfe57bb2d1d90", "tosses_processed", 570,
        "c4a0d45845da0793891b13e21481ce9c0a2631d48ca03a7e009e2568f097edb1",
    ),
    "contactnets-elbow": Tosses(
        "DAIRLab/dair_pll", "5b02d284fcec81ca796b648ef72e842df30db656", "contactnets_elbow", 541,
        "11ee10871afa6cada58a0a50d6ce14c26ceccb9d7976a5918454dacd7efd4bb5",
    ),
}  # fmt: skip
CUBE = """version: 1
model: solver
effects: {{sleep: off}}
gravity: [0, 0, {gravity}]
shapes: {{cube: {{box: {{size: [0.1048, 0.1048, 0.1048]}}}}}}
bodies:
  - {{name: table, plane: {{}}, friction: 1, restitution: 1}}
  - {{name: cube, shape: cube, position: [0, 0, 0.2], mass: 0.37, inertia_factor: {factor}}}
"""
# The gravity is that of the recorded falls of the elbow, so that lengths and times agree.
ELBOW = """version: 1
model: solver
effects: {{sleep: off}}
gravity: {gravity}
shapes: {{link: {{box: {{size: [0.1, 0.05, 0.05]}}}}}}
bodies:
  - {{name: table, plane: {{}}, friction: 1, restitution: 1}}
  - {{name: one, shape: link, position: [0, 0, 0.2], mass: 0.37}}
  - {{name: two, shape: link, position: [0, 0.06, 0.2], mass: 0.37}}
joints:
  - {{name: elbow, type: hinge, bodies: [two, one], anchor: [-0.035, 0.06, 0.2], axis: [0, 1, 0]}}
"""
FALL = [0.1, 0.05, -9.64]  # m/s^2, in all flights of the elbow


def public_tosses(name: Path, on_progress: Progress = silent) -> Path:
    """The folder of this name, else that of the public set of this name in `SETS`, with its `tosses.npz` and
    `scene.yaml`, fetched if necessary. Raises SdfsimError if the download failed or is not the expected one."""
    if str(name) not in SETS or name.exists():
        return name
    known, folder = SETS[str(name)], user_cache("public") / name
    if not all((folder / file).is_file() for file in ("tosses.npz", "scene.yaml")):
        on_progress(0.0, f"fetching {known.url}")
        by_hand = folder / f"{known.commit}{ARCHIVE}"
        found = fetched(known.url, f"put it into {by_hand.parent} by hand, as {by_hand.name}", known.folder, by_hand)
        files = [found.get(f"{k}.pt", b"") for k in range(known.count)]
        if (got := hashlib.sha256(b"".join(files)).hexdigest()) != known.checksum:
            reason = f"its {known.count} files have the SHA-256 {got}, not {known.checksum}"
            raise SdfsimError(f"{known.url}: not the expected tosses: {reason}", f"remove {by_hand}, if it is there")
        arrays, scene = (_cube if name.name.endswith("cube") else _elbow)([_tensor(content) for content in files])
        folder.mkdir(parents=True, exist_ok=True)
        write_arrays(folder / "tosses.npz", arrays)
        write_text(folder / "scene.yaml", scene)
    return folder


def _tensor(content: bytes) -> np.ndarray:
    import torch

    return torch.load(io.BytesIO(content), weights_only=True).numpy()


def _cube(files: Sequence[np.ndarray]) -> tuple[dict[str, np.ndarray], str]:
    """From rows [1, T, 19]: position in half sides, quaternion wxyz, velocities."""
    rows = [file.reshape(-1, 19) for file in files]
    poses, scene = np.concatenate(rows), CUBE.format(gravity=-9.81, factor=1.196)
    return _arrays([len(r) for r in rows], UNIT * poses[:, None, :3], poses[:, None, [4, 5, 6, 3]], ["cube"]), scene


def _elbow(files: Sequence[np.ndarray]) -> tuple[dict[str, np.ndarray], str]:
    """From rows [T, 15]: quaternion wxyz and position of the first link, angle of the hinge, velocities."""
    links = [links_of(r[:, 4:7], Rotation.from_quat(r[:, [1, 2, 3, 0]]), r[:, 7]) for r in files]
    links = [upright(both, number) for number, both in enumerate(links)]
    place, turn = (np.concatenate([getattr(both, n) for both in links]) for n in Links._fields)
    return _arrays([len(r) for r in files], place, turn, ["one", "two"]), ELBOW.format(gravity=FALL)


def _arrays(counts: Sequence[int], place: np.ndarray, turn: np.ndarray, names: list[str]) -> dict[str, np.ndarray]:
    return {
        "start": np.cumsum([0, *counts]), "dt": np.array(1.0 / RATE), "names": np.array(names),
        "position": place, "quat_xyzw": turn / np.linalg.norm(turn, axis=-1, keepdims=True),
    }  # fmt: skip


# --- the elbow ---

LINK = np.array([0.1, 0.05, 0.05])  # m
PIVOT, ARM = np.array([-0.035, 0.06, 0.0]), np.array([0.035, 0.0, 0.0])  # m: link 1 to the hinge, that to link 2
# The axes of the first recordings are tilted by 2.3 degrees against the table, by the mean normal of the faces on which
# links came to rest. From the 323rd on the axes are upright to 0.1 degrees. In the recordings between, no link rests on
# a face.
TILTED, NORMAL = 322, np.array([-0.0310, 0.0261, 0.99918])


class Links(NamedTuple):
    """Poses of both links in T frames."""

    position: np.ndarray  # [T, 2, 3] m
    quat_xyzw: np.ndarray  # [T, 2, 4]


def links_of(place: np.ndarray, one: Rotation, angle: np.ndarray) -> Links:
    """Both links, from the pose of the first (position [T, 3] m) and the angle [T] rad of the hinge."""
    two = one * Rotation.from_rotvec(angle[:, None] * [0.0, 1.0, 0.0])
    other = place + one.apply(PIVOT) + two.apply(ARM)
    return Links(np.stack([place, other], 1), np.stack([one.as_quat(), two.as_quat()], 1))


def upright(links: Links, number: int) -> Links:
    """A recording in axes that are upright on the table; its number determines its own axes. Its authors shifted each
    so that the lowest corner of its last frame is at z = 0, and so does this."""
    if number >= TILTED:
        return links
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], NORMAL[None] / np.linalg.norm(NORMAL))[0]
    place = turn.apply(links.position.reshape(-1, 3)).reshape(links.position.shape)
    turns = (turn * Rotation.from_quat(links.quat_xyzw.reshape(-1, 4))).as_quat().reshape(links.quat_xyzw.shape)
    place[..., 2] -= lowest(Links(place, turns))[-1].min()
    return Links(place, turns)


def lowest(links: Links) -> np.ndarray:
    """[T, 2] m, the height of each link's lowest corner."""
    up = Rotation.from_quat(links.quat_xyzw.reshape(-1, 4)).as_matrix()[:, 2]
    return links.position[..., 2] - 0.5 * (np.abs(up) @ LINK).reshape(-1, 2)
