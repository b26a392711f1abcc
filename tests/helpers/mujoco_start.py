"""Exported scenes in MuJoCo."""

from pathlib import Path

import mujoco  # noqa: TID253


def at_start(file: Path) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The model of an MJCF file and its state at the first keyframe."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return model, data
