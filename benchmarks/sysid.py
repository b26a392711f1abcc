"""MuJoCo's own system identification on the recorded tosses of a cube, compared with `sdfsim identify`:
docs/identify.md.

    pip install 'mujoco[sysid]'
    python -m benchmarks sysid TOSSES

MuJoCo's least squares (`mujoco.sysid.optimize`) fit the parameters of benchmarks/tosses.py, from the middle of their
bounds, to the first frames of 60 tosses. Errors are measured on the 100 other tosses of that benchmark, over
its 75 frames, from the same starts.
"""

import contextlib
import io
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.records import write_record
from benchmarks.tosses import A_CUBE, FRAMES, SIDE, SOFT, drawn, errors, mujoco, recorded, with_interval
from sdfsim.base.errors import SdfsimError
from sdfsim.base.lazy import optional
from sdfsim.evaluation.harness import one_thread

SHORT = (25, 40, FRAMES)


@one_thread()
def main(tosses: Path) -> None:
    """Fit over each number of frames, and record the errors over all compared frames."""
    toolbox: Any = optional("mujoco.sysid", "MuJoCo's sysid", "bench")
    if not hasattr(toolbox, "optimize"):  # it hides import errors
        raise SdfsimError("MuJoCo's sysid is not installed", "pip install 'mujoco[sysid]'")
    dt, known = A_CUBE.tosses(tosses)
    with tempfile.TemporaryDirectory() as folder:
        thing = A_CUBE.load(Path(folder))
    (fit, fit_truth), (test, test_truth) = (
        ([r for _, r in group], recorded([toss for toss, _ in group]))
        for group in drawn(A_CUBE.begun(known, dt, thing))[:2]
    )
    turns = Rotation.from_quat(fit_truth.quat_xyzw.reshape(-1, 4))
    rows, notes = [], []
    for horizon in SHORT:
        runs = [0]

        def off(x: np.ndarray, _: Any, horizon: int = horizon, runs: list[int] = runs) -> tuple[list, None, None]:
            """Residuals of positions in sides and rotations in rad; a column for each of `x` [parameters, columns]."""
            columns = []
            for point in np.atleast_2d(x.T):
                runs[0] += 1
                found = mujoco(thing, A_CUBE.inertia, fit, dt, dict(zip(SOFT, point, strict=True)))
                turned = (Rotation.from_quat(found.quat_xyzw.reshape(-1, 4)) * turns.inv()).as_rotvec()
                away = np.concatenate(
                    [(found.position - fit_truth.position) / SIDE, turned.reshape(found.position.shape)], -1
                )
                columns.append(away[:, :horizon].ravel())
            return [columns[0] if x.ndim == 1 else np.stack(columns, 1)], None, None

        wanted = toolbox.ParameterDict(
            {name: toolbox.Parameter(name, 0.5 * (a + b), a, b) for name, (a, b) in SOFT.items()}
        )
        began = time.process_time()
        with contextlib.redirect_stdout(io.StringIO()):  # one line per iteration
            made, _ = toolbox.optimize(wanted, off, verbose=False, max_iters=50)
        spent = time.process_time() - began
        values = dict(zip(SOFT, made.as_vector().tolist(), strict=True))
        name = f"MuJoCo, `mujoco.sysid` on the first {horizon} frames"
        judged = errors(mujoco(thing, A_CUBE.inertia, test, dt, values), test_truth, SIDE)
        rows.append((name, *map(with_interval, judged), spent))
        found = ", ".join(f"{of} {value:.4g}" for of, value in values.items())
        notes.append(f"- {horizon} frames, {runs[0]} runs of all tosses: {found}")
    columns = ("on the 100 others", "position, % of the side", "rotation, degrees", "processor s")
    measured = (
        "MuJoCo's least squares on 60 tosses of a cube, from the middle of the bounds; errors on 100 others over "
        f"{FRAMES} frames, means with 95 % intervals."
    )
    write_record("sysid", "python -m benchmarks sysid TOSSES", measured, columns, rows, notes)
