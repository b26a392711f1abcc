"""A scene as a Gymnasium environment. To make one of your own, copy a class of `tasks.py` and change its words."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sdfsim.base.errors import SdfsimError
from sdfsim.scene.builder import SceneBuilder, loaded
from sdfsim.scene.scene import Scene
from sdfsim.simulate.camera import Camera
from sdfsim.simulate.worlds import Batch

Seen = Mapping[str, np.ndarray]  # entry of `observe` -> [W, n]
BONUS = 0.1
OBS_TYPES = ("state", "pixels", "pixels_agent_pos")


class Task(VectorEnv):
    """Many worlds of one scene, in which a policy acts; `single` is one of them as a `gymnasium.Env`.

    A subclass names what acts, what is observed and what varies, as for `sdfsim.Batch`, and writes the methods below.
    Actions are numbers from -1 to 1. The reward is what the score gains in a step, and `BONUS` more with success; an
    episode ends when `score` says so, or after `seconds`.

    Args:
        num_envs: number of worlds, W.
        scene: what `build` begins from, such as "room/scene.yaml"; None: a table of its own.
        obs_type: "state": what `look` returns; or a dict as LeRobot takes it: "pixels" [H, W, 3] uint8, and with
            "pixels_agent_pos" also "agent_pos": positions of joints.
        width, height: of images, px.
        threads: as for `sdfsim.Batch`.
        options: for `build`.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.SAME_STEP,
    }  # fmt: skip
    act: Sequence[str] = ()
    observe: Sequence[str] = ()
    vary: Mapping[str, Mapping[str, Any]] = {}
    goal: tuple[Sequence[float], Sequence[float]] = ((), ())  # lowest and highest of the numbers that an episode draws
    actions = 0  # their number
    dt, period, seconds = 0.01, 0.1, 4.0  # s: the step, the time between two actions, an episode
    task_description = ""

    def build(self, scene: Any, **options: Any) -> Scene | SceneBuilder:
        """The scene; may set the names above by its bodies."""
        raise NotImplementedError

    def command(self, seen: Seen, goal: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """[W, A] what acts, from actions of -1 to 1."""
        raise NotImplementedError

    def look(self, seen: Seen, goal: np.ndarray) -> np.ndarray:
        """[W, O] what the policy is told."""
        return np.concatenate([*seen.values(), goal], 1)

    def score(self, seen: Seen, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[W] how good a state is; whether it is what is wanted; and whether the episode is over, as something fell."""
        raise NotImplementedError

    def __init__(
        self, num_envs: int = 1, *, scene: Scene | SceneBuilder | Path | str | None = None, obs_type: str = "state",
        render_mode: str | None = None, width: int = 96, height: int = 96, threads: int | None = None, **options: Any,
    ) -> None:  # fmt: skip
        if obs_type not in OBS_TYPES:
            raise SdfsimError(f"obs_type: must be one of {', '.join(OBS_TYPES)} (got {obs_type!r})")
        made = self.build(SceneBuilder.read(scene) if isinstance(scene, str | Path) else scene, **options)
        self.batch = Batch(
            loaded(made), num_envs, act=self.act, observe=self.observe, vary=self.vary, dt=self.dt, threads=threads
        )
        self.num_envs, self.obs_type, self.render_mode = num_envs, obs_type, render_mode
        self.camera = Camera.fit(self.batch.simulator, width=width, height=height)
        self.limit, self._steps, self.ends = round(self.seconds / self.period), np.zeros(num_envs, int), True
        self.goals, self._scores = np.zeros((num_envs, len(self.goal[0]))), np.zeros(num_envs)
        self.agent = [entry for entry in self.batch.observed if entry.startswith("joint_position")]
        self.single_action_space = Box(-1.0, 1.0, (self.actions,), np.float32)
        pixels, own = Box(0, 255, (height, width, 3), np.uint8), Box(-np.inf, np.inf, (len(self.agent),), np.float32)
        self.single_observation_space = {
            "state": Box(-np.inf, np.inf, self.look(self.seen, self.goals).shape[1:], np.float32),
            "pixels": Dict({"pixels": pixels}), "pixels_agent_pos": Dict({"pixels": pixels, "agent_pos": own}),
        }[obs_type]  # fmt: skip
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    @property
    def seen(self) -> Seen:
        """What the batch observes, by the entries of `observe`."""
        found = self.batch.observe()
        return {entry: found[:, place] for entry, place in self.batch.observed.items()}

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin anew in all worlds, or in those of `options["reset_mask"]` [W] bool. The same seed repeats all draws,
        bit by bit."""
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        self._begin(np.flatnonzero(mask), None if seed is None else int(np.ravel(seed)[0]))
        return self._observation(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """As any vector environment; worlds whose episode ends begin the next one at once ("final_obs" of the infos has
        the last observation), and "is_success" tells which are as wanted."""
        if np.shape(actions) != (self.num_envs, self.actions):
            wanted = [self.num_envs, self.actions]
            raise SdfsimError(f"actions: must be {wanted} (got {list(np.shape(actions))})")
        command = self.command(self.seen, self.goals, np.clip(np.asarray(actions, float), -1.0, 1.0))
        self.batch.step(command, round(self.period / self.batch.dt))
        self._steps += 1
        score, success, lost = self.score(self.seen, self.goals)
        reward, self._scores = score - self._scores + BONUS * success, score
        lost, late = lost | self.batch.failed, self._steps >= self.limit
        infos: dict[str, Any] = {"is_success": success, "_is_success": np.ones(self.num_envs, bool)}
        found, over = self._observation(), lost | late
        if self.ends and over.any():
            infos |= {"final_obs": np.array([None] * self.num_envs), "_final_obs": over}
            for w in np.flatnonzero(over).tolist():
                infos["final_obs"][w] = _of(found, w)
            self._begin(np.flatnonzero(over))
            found = self._observation()
        return found, reward, lost, late & ~lost, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each world, [H, W, 3] uint8."""
        return tuple(self.batch.image(self.camera, w).color for w in range(self.num_envs)) if self.render_mode else None

    @classmethod
    def single(cls, **options: Any) -> gymnasium.Env:
        """One world as a `gymnasium.Env`."""
        return _Single(cls(1, **options))

    def _begin(self, rows: np.ndarray, seed: int | None = None) -> None:
        self.batch.reset(rows, seed=seed)
        self._steps[rows] = 0
        low, high = np.array(self.goal)
        for w in rows.tolist():
            rng = np.random.default_rng([self.batch.seed, w, int(self.batch.draws[w]), 1])
            self.goals[w] = low + (high - low) * rng.random(low.shape)
        self._scores[rows] = self.score(self.seen, self.goals)[0][rows]

    def _observation(self) -> Any:
        if self.obs_type == "state":
            return self.look(self.seen, self.goals).astype(np.float32)
        found = {"pixels": np.stack([self.batch.image(self.camera, w).color for w in range(self.num_envs)])}
        if self.obs_type == "pixels_agent_pos":
            own = [np.zeros((self.num_envs, 0)), *(self.seen[entry] for entry in self.agent)]
            found["agent_pos"] = np.concatenate(own, 1).astype(np.float32)
        return found


class _Single(gymnasium.Env):
    """The only world of a task."""

    def __init__(self, many: Task) -> None:
        self.many, self.metadata, self.render_mode = many, many.metadata, many.render_mode
        many.ends = False
        self.observation_space, self.action_space = many.single_observation_space, many.single_action_space
        self.task = self.task_description = many.task_description
        self._max_episode_steps = many.limit

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return _of(self.many.reset(seed=seed)[0], 0), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        found, reward, lost, late, infos = self.many.step(np.asarray(action)[None])
        told = {"is_success": bool(infos["is_success"][0])}
        return _of(found, 0), float(reward[0]), bool(lost[0]), bool(late[0]), told

    def render(self) -> Any:
        pictures = self.many.render()
        return None if pictures is None else pictures[0]


def _of(found: Any, w: int) -> Any:
    """The observation of one world."""
    return {key: value[w] for key, value in found.items()} if isinstance(found, dict) else found[w]
