"""The test study (`Test Study`): trials of a trained run, or of the PID, from the test start pose.

    python evaluate.py data/runs/NAME --trials 500 --jobs 2        # prints the table, writes NAME/evaluation.csv
    python evaluate.py data/runs/NAME --gif agent.gif              # or --watch, in a window
    python evaluate.py --pid --task p2p --gains fast --trials 500

P_scs: successful trials; over the successful ones T_eff: 100 * mean norm(tau_hat) / 2, in percent of the largest
possible; R_test: mean return; E_95: mean norm(e) over the last 5 % of the steps, in cm. Trial i has the same goal for
every agent, and nothing depends on the number of jobs.
"""

import argparse
import csv
import io
import math
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import gymnasium
import numpy as np
import torch
from tqdm import tqdm

import gas
import logx
import pid_demo
from kinova_env import OBSERVATION, TASKS, grasped

COLUMNS = ["trial", "success", "failure", "grasped", "length", "return", "effort_percent", "final_error_cm", "e95_cm"]
COLUMNS += ["goal_theta", "goal_rho", "goal_z"]
FIRST_SEED = 1_000_000  # trial i resets with seed FIRST_SEED + i: far from the seeds that runs train with


class Policy:
    """A deterministic policy as stored in `policy.pt`: callable, obs (n,) float32 -> action (4,) float32.

    stored: {"task", "symmetry", "sizes": [n, ..., 4], "output": "tanh" | "linear", "weights": {name: tensor}}, and
    perhaps "grasp_input": True where the network has one input more, 1 while the cube is grasped.
    """

    def __init__(self, stored):
        self.task = stored["task"]
        self.canonical = stored["symmetry"] == "canonical"
        sizes = stored["sizes"]
        self.grasp_input = bool(stored.get("grasp_input"))
        if (sizes[0] - self.grasp_input, sizes[-1]) != (sum(width for _, width, _ in OBSERVATION[self.task]), 4):
            raise ValueError(f"sizes {sizes} do not fit task {self.task}")
        layers = []
        with torch.device("meta"):  # draws no random numbers: a policy may be made in the middle of a run
            for n_in, n_out in zip(sizes[:-1], sizes[1:], strict=True):
                layers += [torch.nn.Linear(n_in, n_out), torch.nn.ReLU()]
        net = torch.nn.Sequential(*layers[:-1])
        net.load_state_dict(stored["weights"], assign=True)
        self.net = torch.nn.Sequential(net, torch.nn.Tanh() if stored["output"] == "tanh" else torch.nn.Identity())

    def __call__(self, obs):
        s = gas.canonical(obs) if self.canonical else obs
        if self.grasp_input:
            s = np.concatenate((s, np.float32(grasped(s))[..., None]), axis=-1)
        with torch.inference_mode():
            return np.clip(self.net(torch.from_numpy(s)).numpy(), -1, 1)


def load_policy(run_folder):
    """The policy of a run folder (its `policy.pt`). Raises ValueError with what is wrong with the file."""
    path = Path(run_folder) / "policy.pt"
    stored = logx.load_torch(path)
    try:
        if not isinstance(stored, dict):
            raise TypeError(f"holds a {type(stored).__name__}")
        return Policy(stored)
    except (LookupError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a policy of ours ({logx.one_line(error)})") from None


def trial(env, act, i):
    """Runs test trial i to its end. Returns its row of evaluation.csv (dict) and ||e_t|| in m (length + 1,)."""
    s, info = env.reset(seed=FIRST_SEED + i)
    errors, total, effort, done = [info["distance"]], 0.0, 0.0, False
    while not done:
        s, r, terminated, truncated, info = env.step(act(s))
        total, effort = total + r, effort + info["effort"]
        errors.append(info["distance"])
        done = terminated or truncated
    length = len(errors) - 1
    last = max(1, math.ceil(0.05 * length))
    x, y, z = env.unwrapped.goal
    row = {
        "trial": i,
        "success": int(info["is_success"]),
        "failure": "" if info["is_success"] else info["collision"] or "timeout",
        "grasped": int(info["grasped"]),
        "length": length,
        "return": total,
        "effort_percent": 100 * effort / length / 2,  # norm(tau_hat) is at most sqrt(4) = 2
        "final_error_cm": 100 * errors[-1],
        "e95_cm": 100 * sum(errors[-last:]) / last,
        "goal_theta": math.atan2(y, x),
        "goal_rho": math.hypot(x, y),
        "goal_z": z,
    }
    return row, np.array(errors, dtype=np.float32)


def make_agent(task, source):
    """(test environment, act(obs)) of a run folder, or of the PID where `source` is a name or triple of gains."""
    env = gymnasium.make(TASKS[task].env_id, stage="test", disable_env_checker=True)
    if isinstance(source, Path):
        return env, load_policy(source)
    pid = pid_demo.PID(env, source)
    return env, lambda s: pid.act()


def _trials(job):
    task, source, numbers = job
    torch.set_num_threads(1)
    env, act = make_agent(task, source)
    rows = [trial(env, act, i)[0] for i in numbers]
    env.close()
    return rows


def run_trials(task, source, trials=500, jobs=1, quiet=False):
    """Test trials 0 ... trials-1. source: a run folder (Path) or PID gains. Returns the rows of evaluation.csv."""
    chunks = [(task, source, list(range(i, min(i + 10, trials)))) for i in range(0, trials, 10)]
    bar = dict(total=len(chunks), desc="trials / 10", disable=quiet or None, leave=False)
    if jobs == 1:
        parts = list(tqdm(map(_trials, chunks), **bar))
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            parts = list(tqdm(pool.map(_trials, chunks), **bar))
    return [row for part in parts for row in part]


def metrics(rows):
    """The paper's test metrics (`Test Study`) of rows of evaluation.csv; NaN where no trial succeeded."""
    won = [row for row in rows if row["success"]]

    def mean(column):
        return sum(row[column] for row in won) / len(won) if won else math.nan

    return {
        "P_scs_percent": 100 * len(won) / len(rows),
        "T_eff": mean("effort_percent"),
        "R_test": mean("return"),
        "E_95_cm": mean("e95_cm"),
        "steps": mean("length"),
    }


def print_table(results):
    """results: {name: rows of evaluation.csv}."""
    print(f"{'agent':44s} trials  P_scs %    T_eff   R_test  E_95 cm  steps   failures")
    for name, rows in results.items():
        m = metrics(rows)
        how = [row["failure"] for row in rows if row["failure"]]
        failures = ", ".join(f"{how.count(f)} {f}" for f in sorted(set(how))) or "none"
        print(
            f"{name:44s} {len(rows):6d} {m['P_scs_percent']:8.1f} {m['T_eff']:8.1f} {m['R_test']:8.2f} "
            f"{m['E_95_cm']:8.2f} {m['steps']:6.0f}   {failures}"
        )


def write_csv(path, rows):
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    table.writeheader()
    table.writerows([{k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows])
    logx.atomic_write(path, lambda file: file.write(text.getvalue().encode()))


def show(task, source, path=None, seed=FIRST_SEED):
    """The first test trials of an agent: six into a GIF at `path`, or three in a window where it is None."""
    mode = dict(render_mode="rgb_array", width=480, height=360) if path else dict(render_mode="human")
    env = gymnasium.make(TASKS[task].env_id, stage="test", disable_env_checker=True, **mode)
    pid = None if isinstance(source, Path) else pid_demo.PID(env, source)
    act = load_policy(source) if pid is None else lambda s: pid.act()
    if path:
        pid_demo.film(env, act, path, episodes=6, seed=seed)
    else:
        for n in range(3):
            s, _ = env.reset(seed=seed + n)
            done = False
            while not done:
                s, _, terminated, truncated, _ = env.step(act(s))
                done = terminated or truncated
    env.close()


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, usage=argparse.SUPPRESS, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="run folders")
    parser.add_argument("--pid", action="store_true", help="the PID demonstrator instead of a run")
    parser.add_argument("--task", choices=TASKS, help="with --pid")
    parser.add_argument("--gains", choices=pid_demo.GAINS, default="authors", help="with --pid")
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=1, help="worker processes")
    parser.add_argument("--gif", metavar="FILE", help="film six trials instead")
    parser.add_argument("--watch", action="store_true", help="three trials in PyBullet's window instead")
    flags = parser.parse_args()
    for name in ("trials", "jobs"):
        if getattr(flags, name) < 1:
            parser.error(f"--{name} {getattr(flags, name)}: must be at least 1")
    if flags.pid == bool(flags.runs):
        parser.error("RUN or --pid --task T: name run folders or ask for the PID, not both")
    if flags.pid and not flags.task:
        parser.error(f"--pid: needs --task, one of {', '.join(TASKS)}")
    if flags.gif and not Path(flags.gif).absolute().parent.is_dir():
        parser.error(f"--gif {flags.gif}: its folder does not exist")
    if (flags.gif or flags.watch) and len(flags.runs) > 1:
        parser.error("--gif, --watch: one run at a time")
    agents = {}
    for folder in flags.runs:
        try:
            agents[str(folder)] = (load_policy(folder).task, folder)
        except ValueError as error:
            parser.error(str(error))
    if flags.pid:
        agents[f"PID, {flags.gains} gains, {flags.task}"] = (flags.task, flags.gains)
    if flags.gif or flags.watch:
        try:
            show(*next(iter(agents.values())), flags.gif)
        except ValueError as error:
            parser.error(str(error))
        if flags.gif:
            print(f"wrote {flags.gif}")
        return
    results = {}
    for name, (task, source) in agents.items():
        results[name] = run_trials(task, source, flags.trials, flags.jobs)
        if isinstance(source, Path):
            write_csv(source / "evaluation.csv", results[name])
    print_table(results)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
