"""Learn to push a mug to a place on a table, in about seven minutes of one core.

    python samples/learn/push.py                        # trains, or goes on; writes policy, curve and film to push/
    python samples/learn/push.py --scene room/scene.yaml --body mug     # on your own table
    python samples/learn/push.py --mujoco               # the same policy in MuJoCo, on the exported scene

It needs `pip install 'sdfsim[learn]'`, and `[bench]` for MuJoCo and the curve.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from ppo import Policy, success, train

from sdfsim.apps.mujoco_world import MujocoWorld
from sdfsim.base.errors import run_main
from sdfsim.envs import Push
from sdfsim.simulate.camera import Camera
from sdfsim.simulate.simulator import varied

STEP = 0.002  # s, of MuJoCo


def film(env: Any, policies: list[Policy], file: Path, seed: int) -> None:
    """An animation of the first worlds: for each policy a row."""
    frames: list[list[np.ndarray]] = []
    for policy in policies:
        seen, _ = env.reset(seed=seed)
        shown = []
        for _ in range(env.limit - 1):
            pictures = [env.batch.image(env.camera, w).color for w in range(env.num_envs)]
            for w, picture in enumerate(pictures):  # a red dot at the goal
                goal = np.array([*env.goals[w] + env.start, env.floor])
                (column, row), _ = env.camera.project(goal)
                picture[int(row) - 2 : int(row) + 3, int(column) - 2 : int(column) + 3] = (220, 30, 30)
            shown.append(np.concatenate(pictures, 1))
            seen, *_ = env.step(policy.act(seen))
        frames.append(shown)
    images = [Image.fromarray(np.concatenate(rows, 0)) for rows in zip(*frames, strict=True)]
    images[0].save(file, save_all=True, append_images=images[1:], duration=100, loop=0, quality=60)


def draw_curve(folder: Path) -> None:
    import matplotlib.pyplot as plt

    _, seconds, won, _ = np.loadtxt(folder / "curve.csv", delimiter=",", skiprows=1).T
    figure, axis = plt.subplots(figsize=(5, 3), layout="constrained")
    axis.plot(seconds / 60, 100 * won, linewidth=0.6, color="0.7")
    axis.plot(seconds / 60, 100 * np.convolve(np.pad(won, 5, "edge"), np.full(11, 1 / 11), "valid"), color="tab:blue")
    axis.set(xlabel="minutes of one core", ylabel="% of episodes within 5 cm", ylim=(0, 100))
    figure.savefig(folder / "curve.png", dpi=100)


def in_mujoco(env: Push, policy: Policy, seed: int, *, late: int = 0, **options: Any) -> float:
    """The part of episodes that end in success in MuJoCo: one for each world, with the same starts, frictions, masses
    and goals. Actions act `late` periods later; `options` for `MujocoWorld`."""
    env.reset(seed=seed)
    won = []
    for w in range(env.num_envs):
        world = MujocoWorld(varied(env.batch.scene, env.batch.drawn[w]), STEP, **options)
        names = [body.name for body in env.batch.scene.bodies if body.motion == "dynamic"]
        waiting = [np.zeros((1, 2))] * late
        for _ in range(env.limit):
            place, _, speed, _ = world.state()
            seen = {f"position {name}": place[[k]] for k, name in enumerate(names)}
            seen |= {f"velocity {name}": speed[[k]] for k, name in enumerate(names)}
            waiting.append(policy.act(env.look(seen, env.goals[[w]]).astype(np.float32)))
            targets = env.command(seen, env.goals[[w]], waiting.pop(0))[0]
            for joint, value in zip(("rail_x", "rail_y"), targets, strict=True):
                world.data.actuator(f"{joint}_motor").ctrl = value
            world.advance(round(env.period / STEP))
        place = world.state()[0]
        seen = {f"position {name}": place[[k]] for k, name in enumerate(names)}
        won.append(env.score(seen, env.goals[[w]])[1][0])
    return float(np.mean(won))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("push"))
    parser.add_argument("--scene", help="a scene file; default: a mug on a table")
    parser.add_argument("--body", help="what is pushed; default: the first body that moves")
    parser.add_argument("--steps", type=int, default=200_000, help="actions, in all worlds together")
    parser.add_argument("--mujoco", action="store_true", help="run the policy in MuJoCo")
    given = parser.parse_args()
    chosen = {"scene": given.scene, "body": given.body}
    policy = train(Push(64, **chosen), given.out, given.steps)
    fresh = Push(200, **chosen)
    found = [success(fresh, policy, 10**6, noise=noise) for noise in (False, True)]
    print(f"{found[0]:.1%} of 200 new episodes end within 5 cm, {found[1]:.1%} with the noise of training's end")
    if given.mujoco:
        hundred = Push(100, **chosen)
        cases: dict[str, dict[str, Any]] = {
            "as exported": {}, "friction as stiff as contacts": {"impratio": 1.0},
            "softer contacts": {"contact": (0.02, 1.0)}, "stiffer contacts": {"contact": (2 * STEP, 1.0)},
            "actions 0.1 s later": {"late": 1},
        }  # fmt: skip
        print(f"sdfsim: {success(hundred, policy, 10**6):.0%}")
        for what, options in cases.items():
            print(f"MuJoCo, {what}: {in_mujoco(hundred, policy, 10**6, **options):.0%}")
        return
    draw_curve(given.out)
    few = Push(3, width=200, height=150, **chosen)
    target = np.array([*few.start, few.floor])
    few.camera = Camera(target + np.array([0.1, -0.75, 0.65]), look_at=target, width=200, height=150)
    film(few, [Policy(policy.mean[0].in_features, 2), policy], given.out / "film.webp", 5)
    print(f"wrote {given.out}/curve.png and film.webp: above before training, below after it")


if __name__ == "__main__":
    run_main(main)
