"""Exported scenes in MuJoCo."""

from pathlib import Path

import mujoco  # noqa: TID253


def at_start(of: Path | mujoco.MjModel, key: int = 0) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A model, or that of an MJCF file, and its state at a keyframe."""
    model = of if isinstance(of, mujoco.MjModel) else mujoco.MjModel.from_xml_path(str(of))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, key)
    mujoco.mj_forward(model, data)
    return model, data
