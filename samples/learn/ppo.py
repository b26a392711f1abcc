"""Proximal policy optimisation (Schulman et al. 2017) in PyTorch, for the vector environments of `sdfsim.envs`."""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

HORIZON, EPOCHS, MINIBATCH = 40, 10, 320
DISCOUNT, TRACE, CLIP, RATE = 0.97, 0.95, 0.2, 1e-3
FIRST, LAST = 0.6, 0.15  # of the noise of actions, at the beginning and the end: what is learnt is to work without it


class Policy(nn.Module):
    """A Gaussian policy and a value function on the same inputs; `spread` is the standard deviation of its actions."""

    spread = FIRST

    def __init__(self, inputs: int, actions: int, wide: int = 64) -> None:
        super().__init__()

        def net(outputs: int) -> nn.Sequential:
            return nn.Sequential(
                nn.Linear(inputs, wide), nn.Tanh(), nn.Linear(wide, wide), nn.Tanh(), nn.Linear(wide, outputs)
            )

        self.mean, self.value = net(actions), net(1)

    def around(self, seen: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(self.mean(seen), self.spread)

    def act(self, seen: np.ndarray) -> np.ndarray:
        """[W, A] the most likely actions."""
        with torch.no_grad():
            return self.mean(torch.as_tensor(seen)).clamp(-1.0, 1.0).numpy()


def train(env: Any, folder: Path, steps: int, seed: int = 0) -> Policy:
    """Train until `steps` actions were made in all, and keep the policy and its curve in a folder after every update. A
    later call goes on from there."""
    folder.mkdir(parents=True, exist_ok=True)
    file, curve = folder / "policy.pt", folder / "curve.csv"
    torch.manual_seed(seed)
    policy = Policy(env.single_observation_space.shape[0], env.single_action_space.shape[0])
    optimiser, done, spent = torch.optim.Adam(policy.parameters(), RATE), 0, 0.0
    if file.exists():
        known = torch.load(file, weights_only=True)
        policy.load_state_dict(known["policy"])
        optimiser.load_state_dict(known["optimiser"])
        done, spent = known["steps"], known["seconds"]
    else:
        curve.write_text("steps,seconds,success,reward\n")
    seen, _ = env.reset(seed=seed + done)
    while done < steps:
        began = time.process_time()
        left = 1.0 - done / steps
        policy.spread = LAST + left * (FIRST - LAST)
        for group in optimiser.param_groups:
            group["lr"] = RATE * max(0.1, left)
        batch, seen, wins = rollout(env, policy, seen)
        update(policy, optimiser, *batch)
        done += HORIZON * env.num_envs
        spent += time.process_time() - began
        with curve.open("a", newline="") as out:
            csv.writer(out).writerow([done, round(spent, 1), round(float(wins), 3), round(float(batch[-1].mean()), 4)])
        known = {"policy": policy.state_dict(), "optimiser": optimiser.state_dict(), "steps": done, "seconds": spent}
        torch.save(known, file)
        print(f"{done} steps, {spent:.0f} s of CPU: {wins:.0%} of episodes end in success", flush=True)
    policy.spread = LAST
    return policy


def rollout(env: Any, policy: Policy, seen: np.ndarray) -> tuple[tuple[torch.Tensor, ...], np.ndarray, float]:
    """`HORIZON` steps: observations, actions, their log-probabilities, advantages, returns and rewards, each [T * W];
    the last observation; and the part of finished episodes that ended in success."""
    kept: list[tuple[torch.Tensor, ...]] = []
    ended: list[bool] = []
    with torch.no_grad():
        for _ in range(HORIZON):
            now = torch.as_tensor(seen)
            chosen = policy.around(now)
            action = chosen.sample()
            seen, reward, lost, late, infos = env.step(action.numpy())
            gain, over = torch.as_tensor(reward, dtype=torch.float32), torch.as_tensor(lost | late)
            for w in np.flatnonzero(late):  # what would have come after the time limit
                gain[w] += DISCOUNT * policy.value(torch.as_tensor(infos["final_obs"][w]))[0]
            ended += infos["is_success"][lost | late].tolist()
            kept.append((now, action, chosen.log_prob(action).sum(1), policy.value(now)[:, 0], gain, over.float()))
        after, ahead = policy.value(torch.as_tensor(seen))[:, 0], torch.zeros(len(seen))
        observed, actions, likely, values, gains, over = map(torch.stack, zip(*kept, strict=True))
        advantage = torch.zeros_like(values)
        for t in reversed(range(HORIZON)):
            ahead = gains[t] + DISCOUNT * after * (1 - over[t]) - values[t] + DISCOUNT * TRACE * (1 - over[t]) * ahead
            advantage[t], after = ahead, values[t]
    parts = (observed, actions, likely, advantage, advantage + values, gains)
    return tuple(part.flatten(0, 1) for part in parts), seen, float(np.mean(ended)) if ended else 0.0


def update(policy: Policy, optimiser: torch.optim.Optimizer, *batch: torch.Tensor) -> None:
    observed, actions, likely, advantage, returns, _ = batch
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(returns)).split(MINIBATCH):
            chosen = policy.around(observed[rows])
            ratio = (chosen.log_prob(actions[rows]).sum(1) - likely[rows]).exp()
            gain = torch.minimum(ratio * advantage[rows], ratio.clamp(1 - CLIP, 1 + CLIP) * advantage[rows]).mean()
            miss = (policy.value(observed[rows])[:, 0] - returns[rows]).pow(2).mean()
            loss = 0.5 * miss - gain
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()


def success(env: Any, policy: Policy, seed: int, *, noise: bool = False) -> float:
    """The part of the worlds whose next episode ends in success, with the most likely actions, or with the `noise` that
    the policy had at the end of its training."""
    seen, _ = env.reset(seed=seed)
    won, over = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, bool)
    draw = np.random.default_rng(seed)
    while not over.all():
        actions = policy.act(seen)
        actions = actions + policy.spread * draw.standard_normal(actions.shape).astype(np.float32) * noise
        seen, _, lost, late, infos = env.step(actions)
        fresh = (lost | late) & ~over
        won[fresh], over = infos["is_success"][fresh], over | lost | late
    return float(won.mean())
