"""Speed: environment steps a second, and a gradient update against the matrix products in it.

    python tests/benchmark.py            # about a minute, on an otherwise idle machine

The update's matrix products are recorded as they happen (shapes, strides, the tensors themselves) and run again alone;
figures are the best of several rounds, products and updates taking turns.
"""

import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

sys.path.insert(0, str(Path(__file__).parent.parent))
import ddpg_demoease as ddpg  # noqa: E402
from kinova_env import TASKS  # noqa: E402


class Products(TorchDispatchMode):
    """Notes every matrix product that runs inside it, as a call that can be made again."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function.overloadpacket in (torch.ops.aten.addmm, torch.ops.aten.mm):
            left, right = args[-2:]
            self.calls.append((left.detach(), right.detach(), torch.empty(left.shape[0], right.shape[1])))
        return function(*args, **(kwargs or {}))


def environment(task, steps=5000, rounds=8):
    """Steps a second through gymnasium.make with random actions, resets included."""
    env = gymnasium.make(TASKS[task].env_id, disable_env_checker=True)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 4)).astype(np.float32)
    best = 0.0
    for _ in range(rounds):
        env.reset(seed=0)
        begin = time.perf_counter()
        for a in actions:
            _, _, terminated, truncated, _ = env.step(a)
            if terminated or truncated:
                env.reset()
        best = max(best, steps / (time.perf_counter() - begin))
    return best


def update(task, recipe, rounds=15):
    """(seconds of one update in its block, seconds of its matrix products alone, their number, their FLOP)."""
    flags, _ = ddpg.complete(ddpg.Flags(task=task, recipe=recipe))
    width = sum(w for _, w, _ in ddpg.evaluate.OBSERVATION[task])
    learner, buffer = ddpg.Learner(flags, width), ddpg.ReplayBuffer(width, 20_000)
    buffer.rows.normal_(0, 0.3)
    buffer.rows[:, -1] = 0
    buffer.filled = len(buffer.rows)
    learner.block(buffer, buffer, flags.update_every)
    with Products() as products:
        learner.update(buffer.sample(100, 1)[0], buffer.sample(100, 1)[0])
    whole = alone = float("inf")
    with torch.inference_mode():
        flop = sum(2 * a.shape[0] * a.shape[1] * b.shape[1] for a, b, _ in products.calls)
    for _ in range(rounds):
        begin = time.perf_counter()
        learner.block(buffer, buffer, flags.update_every)
        whole = min(whole, (time.perf_counter() - begin) / flags.update_every)
        begin = time.perf_counter()
        with torch.inference_mode():
            for _ in range(flags.update_every):
                for a, b, out in products.calls:
                    torch.mm(a, b, out=out)
        alone = min(alone, (time.perf_counter() - begin) / flags.update_every)
    return whole, alone, len(products.calls), flop


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    for task in TASKS:
        print(f"environment {task:5s} {environment(task):8.0f} steps/s")
    for task in ("p2p", "p2po"):
        for recipe in ("paper", "robust"):
            whole, alone, calls, flop = update(task, recipe)
            print(
                f"update {task:5s} {recipe:7s} {1e3 * whole:6.2f} ms; its {calls} matrix products alone "
                f"{1e3 * alone:6.2f} ms ({flop / alone / 1e9:.0f} GFLOP/s): {whole / alone:.2f} times"
            )
