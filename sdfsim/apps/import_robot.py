"""`import`: turns a URDF or MJCF file into a scene.yaml."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sdfsim.apps.mjcf import read_mjcf
from sdfsim.apps.robot import write_scene
from sdfsim.apps.urdf import read_urdf
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import check_writable
from sdfsim.base.parallel import StageProgress

ENDINGS = (".urdf", ".xacro", ".xml", ".mjcf")


def import_robot(
    source: Path | str,
    out: Path | str,
    *,
    packages: Sequence[Path | str] = (),
    fixed: bool = False,
    floor: bool = False,
    key: str | None = None,
    on_progress: StageProgress = lambda stage, fraction, message: None,
) -> dict[str, Any]:
    """Write the scene.yaml `out`, and a folder of shapes beside it, from a .urdf or .xacro file, or MuJoCo's .xml (or
    .mjcf).

    `packages` are folders of ROS packages, `fixed` holds the root of a URDF, `floor` adds a floor at z = 0 on which
    everything stands, and `key` is the keyframe of an MJCF file to start from. Returns a report: links, joints, files,
    left_out and notes. Raises SdfsimError if the file cannot be read, or if files cannot be written.
    """
    source, out = Path(source), Path(out)
    kind = source.suffix.lower()
    if kind not in ENDINGS:
        raise SdfsimError(f"{source}: unknown format {kind or '(no ending)'}", "it must end in " + " ".join(ENDINGS))
    if out.suffix.lower() not in (".yaml", ".yml"):
        raise SdfsimError(f"{out}: a scene ends in .yaml", "give -o scene.yaml")
    if not source.is_file():
        raise SdfsimError(f"{source}: no such file", "give a .urdf, or a .xml or .mjcf of MuJoCo")
    if kind in (".urdf", ".xacro"):
        if key is not None:
            raise SdfsimError(f"{source}: a URDF has no keyframes", "leave out --key")
        robot = read_urdf(source, packages=[Path(folder) for folder in packages], fixed=fixed)
    else:
        if fixed or packages:
            raise SdfsimError(f"{source}: --fixed and --packages are for a URDF", "an MJCF file contains both")
        robot = read_mjcf(source, key=key)
    if not robot.links:
        raise SdfsimError(f"{source}: describes no bodies", "give the file that has them: it may include this one")
    check_writable(out.parent)
    files, notes = write_scene(robot, out, floor=floor, on_progress=partial(on_progress, "shapes"))
    counts = {"links": len(robot.links), "joints": len(robot.joints)}
    return {"robot": robot.name, **counts, "files": files, "left_out": list(robot.left_out), "notes": notes}
