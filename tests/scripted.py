"""A scripted world, whose episodes are short and end in every way, and runs of both algorithm scripts in it."""

import csv
import math
import signal
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch

import ddpg_demoease as ddpg
import pid_demo
import ppo_demoease as ppo

SCRIPTS = {"ddpg": ddpg, "ppo": ppo}
COMMON = dict(task="p2p", hidden_sizes=(16, 16), epochs=3, steps_per_epoch=40, num_demos=0, lambda_bc=0.0, seed=3,
              batch_size=16, demo_batch_size=8, eval_every=0, checkpoint_every=1, quiet=True)  # fmt: skip
TINY = {
    ddpg: COMMON | dict(max_ep_len=40, start_steps=20, update_after=60, update_every=7, replay_size=1000),
    ppo: COMMON | dict(max_ep_len=40, train_iters=4),
}


class Scripted(gymnasium.Env):
    """What train() needs of an environment; all follows from the seed and the actions. `steps` remembers every step,
    at_step(n) is called in the n-th."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (22,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (4,), np.float32)

    def __init__(self, at_step=None):
        self.steps, self.at_step = [], at_step

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.s = self.np_random.normal(size=22).astype(np.float32)
        self.to_go = int(self.np_random.integers(3, 25))
        self.end = ("timeout", "success", "self")[self.np_random.integers(3)]
        return self.s, {}

    def step(self, a):
        assert a.dtype == np.float32 and a.shape == (4,) and np.isfinite(a).all()
        s, self.to_go = self.s, self.to_go - 1
        self.s = (0.95 * s + 0.2 * np.resize(a, 22)).astype(np.float32)
        end = "" if self.to_go else self.end
        r = float(self.s[5]) + (10 if end == "success" else 0)
        terminated, truncated = end in ("success", "self"), end == "timeout"
        self.steps.append(SimpleNamespace(s=s, a=a.copy(), r=r, s2=self.s, terminated=terminated, truncated=truncated,
                                          end=end))  # fmt: skip
        if self.at_step:
            self.at_step(len(self.steps))
        info = {"is_success": end == "success", "collision": "self" if end == "self" else ""}
        return self.s, r, terminated, truncated, info


def scripted_run(script, data_dir, name, at_step=None, recorded=None, **changes):
    """train() in a Scripted world with the TINY flags and changes. recorded: the demonstrations. Returns the run's
    folder, the world's steps, and what the run raised."""
    flags = script.Flags(**TINY[script] | dict(name=name, data_dir=str(data_dir)) | changes)
    return run_flags(script, flags, at_step, recorded)


def run_flags(script, flags, at_step=None, recorded=None):
    env, error = Scripted(at_step), None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(script, "gymnasium", SimpleNamespace(make=lambda *args, **kwargs: env))
        if recorded:
            patch.setattr(pid_demo, "demonstrations", lambda flags: (recorded, len(recorded["rew"])))
        try:
            script.train(flags)
        except (Exception, KeyboardInterrupt) as stopped:
            error = stopped
    return SimpleNamespace(folder=Path(flags.data_dir, str(flags.name)), steps=env.steps, error=error)


def interrupt_at(step, number=signal.SIGINT):
    return lambda n: signal.raise_signal(number) if n == step else None


def finished_run(script, data_dir, name, **changes):
    """A scripted run that comes to its end."""
    run = scripted_run(script, data_dir, name, **changes)
    if run.error:
        raise run.error
    return run


def states(n, obs_dim=22, seed=0):
    """Random states (n, obs_dim) with sines and cosines that fit the angles."""
    rng = np.random.default_rng(seed)
    s = rng.normal(size=(n, obs_dim))
    s[:, :4] = rng.uniform(-math.pi, math.pi, (n, 4))
    s[:, 4:8], s[:, 8:12] = np.sin(s[:, :4]), np.cos(s[:, :4])
    return s.astype(np.float32)


DEMO_ENDS = [("success", 6), ("self", 4), ("timeout", 5), ("left its sector", 3)]


def demo_arrays():
    """Four demonstrations, one of each end, as pid_demo.record gives them."""
    rng, lengths = np.random.default_rng(5), [length for _, length in DEMO_ENDS]
    n, last = sum(lengths), np.cumsum(lengths) - 1
    demos = dict(obs=states(n, seed=1), act=rng.uniform(-1, 1, (n, 4)).astype(np.float32), rew=rng.normal(size=n),
                 obs2=states(n, seed=2), terminated=np.zeros(n, bool), truncated=np.zeros(n, bool),
                 episode=np.repeat(np.arange(4), lengths), partition=np.zeros(4, int), length=np.array(lengths),
                 success=np.array([True, False, False, False]))  # fmt: skip
    demos["return"] = np.zeros(4)
    demos["terminated"][last[:2]] = True
    demos["truncated"][last[2:]] = True
    return demos


def rows_of(path):
    return list(csv.DictReader(path.open()))


def curves(folder):
    """episodes.csv, progress.csv but for its seconds, and policy.pt: what equal runs share byte by byte."""
    progress = rows_of(folder / "progress.csv")
    for row in progress:
        row.pop("seconds")
    return (folder / "episodes.csv").read_bytes(), progress, (folder / "policy.pt").read_bytes()


def checkpoint(folder):
    return torch.load(folder / "checkpoint.pt", weights_only=True)


def demonstrated(script, folder):
    """The rows of B_d in a run's checkpoint."""
    return checkpoint(folder)["B_d"]["rows"] if script is ddpg else checkpoint(folder)["demo_rows"]
