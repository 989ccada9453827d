"""Speed on one thread: environment steps a second, and milliseconds of one gradient update.

    python tests/benchmark.py            # about a minute, on an otherwise idle machine

Each figure is the best of several rounds.
"""

import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
import ddpg_demoease as ddpg  # noqa: E402
import ppo_demoease as ppo  # noqa: E402
from kinova_env import OBS_DIM, TASKS  # noqa: E402


def seconds(work, rounds=5):
    """The shortest of several rounds."""
    found = []
    for _ in range(rounds):
        begin = time.perf_counter()
        work()
        found.append(time.perf_counter() - begin)
    return min(found)


def environment(task, steps=3000):
    """Steps a second of random actions, resets included."""
    env = gymnasium.make(TASKS[task].env_id, disable_env_checker=True)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 4)).astype(np.float32)

    def work():
        env.reset(seed=0)
        for a in actions:
            _, _, terminated, truncated, _ = env.step(a)
            if terminated or truncated:
                env.reset()

    work()
    return steps / seconds(work)


def ddpg_update(task, recipe, updates=20):
    f = ddpg.resolve(ddpg.Flags(task=task, recipe=recipe))
    learner, B = ddpg.Learner(f), ddpg.ReplayBuffer(OBS_DIM[task], 20_000, f.symmetry)
    B.load({"rows": torch.randn(B.rows.shape), "next": 0})
    learner.updates(B, B, updates)
    return seconds(lambda: learner.updates(B, B, updates)) / updates


def ppo_update(task, recipe):
    """With all of an epoch's updates, whatever the KL; its sums over the trajectories are part of it."""
    f = ppo.resolve(ppo.Flags(task=task, recipe=recipe, target_kl=1e9))
    learner, B = ppo.Learner(f), ppo.TrajectoryBuffer(OBS_DIM[task], f.steps_per_epoch, f.symmetry)
    rows = torch.randn(B.rows.shape)
    rows[:, -3:] = torch.tensor([0.0, 1.0, 1.0])  # zeta, end, own
    B.extend(rows)
    learner.updates(B, B)
    return seconds(lambda: learner.updates(B, B)) / f.train_iters


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    for task in TASKS:
        print(f"environment {task:5s} {environment(task):8.0f} steps/s")
    for name, update, tasks in (("ddpg", ddpg_update, ("p2p", "p2po")), ("ppo", ppo_update, ("pnp",))):
        for task in tasks:
            for recipe in ("paper", "robust"):
                print(f"{name:4s} update {task:5s} {recipe:7s} {1e3 * update(task, recipe):6.2f} ms")
