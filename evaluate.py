"""The test study (`Test Study`): trials of a trained run, or of the PID, from the test start pose.

    python evaluate.py data/runs/NAME --trials 500 --jobs 2        # prints the table, writes NAME/evaluation.csv
    python evaluate.py data/runs/NAME --gif agent.gif --show 0 7   # trials 0 and 7; or --watch, in a window
    python evaluate.py data/runs/NAME --versus data/runs/OTHER     # the paired difference on the same trials
    python evaluate.py --pid --task p2p --gains fast --trials 500

P_scs: successful trials; over the successful ones T_eff: 100 * mean norm(tau_hat) / 2, in percent of the largest
possible; R_test: mean return; E_95: mean norm(e) over the last 5 % of the steps, in cm. Trial i has the same goal for
every agent, and nothing depends on the number of jobs.
"""

import argparse
import csv
import importlib.util
import io
import json
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
PATHS = 20  # trials whose TCP paths are kept
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
    """Runs test trial i to its end. Returns its row of evaluation.csv (dict), ||e_t|| in m (length + 1,), the path of
    the TCP in m (length + 1, 3), and where the goal and (NaN on P2P) the cube were at its start, in m (2, 3)."""
    s, info = env.reset(seed=FIRST_SEED + i)
    start = [tuple(env.unwrapped.goal), tuple(getattr(env.unwrapped, "cube", (math.nan,) * 3))]
    errors, path, total, effort, done = [info["distance"]], [env.unwrapped.tcp], 0.0, 0.0, False
    while not done:
        s, r, terminated, truncated, info = env.step(act(s))
        total, effort = total + r, effort + info["effort"]
        errors.append(info["distance"])
        path.append(env.unwrapped.tcp)
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
    return row, np.array(errors, dtype=np.float32), np.array(path, dtype=np.float32), np.array(start)


def make_agent(task, source, **render):
    """(test environment, act(obs)) of a run folder, or of the PID where `source` is a name or triple of gains."""
    env = gymnasium.make(TASKS[task].env_id, stage="test", disable_env_checker=True, **render)
    if isinstance(source, Path):
        return env, load_policy(source)
    pid = pid_demo.PID(env, source)
    return env, lambda s: pid.act()


def _trials(job):
    task, source, numbers = job
    torch.set_num_threads(1)
    env, act = make_agent(task, source)
    done = []
    for i in numbers:
        done.append(trial(env, act, i))
    env.close()
    return done


def run_trials(task, source, trials=500, jobs=1, quiet=False):
    """Test trials 0 ... trials-1. source: a run folder (Path) or PID gains. Returns the rows of evaluation.csv and the
    arrays of trajectories.npz: `length`, `success` (trials,), `error` in m, every trial's length + 1 values one after
    another, and of the first PATHS trials `tcp` in m, alike, `goal` and `object` as the trial began (n, 3)."""
    chunks = [(task, source, list(range(i, min(i + 10, trials)))) for i in range(0, trials, 10)]
    bar = dict(total=len(chunks), desc="trials / 10", disable=quiet or None, leave=False)
    if jobs == 1:
        parts = list(tqdm(map(_trials, chunks), **bar))
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            parts = list(tqdm(pool.map(_trials, chunks), **bar))
    rows, errors, tcp, starts = zip(*(done for part in parts for done in part), strict=True)
    goal, cube = np.array(starts[:PATHS]).swapaxes(0, 1)
    trajectories = {"length": np.array([row["length"] for row in rows]), "error": np.concatenate(errors)}
    trajectories |= {"success": np.array([row["success"] for row in rows], dtype=bool)}
    return list(rows), trajectories | {"tcp": np.concatenate(tcp[:PATHS]), "goal": goal, "object": cube}


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


def intervals(rows):
    """95 % intervals (low, high) of `metrics`: Wilson's for P_scs, Student's for means over the successful trials."""
    from scipy import stats  # a second, which a training run need not spend

    n, m = sum(row["success"] for row in rows), metrics(rows)
    low, high = stats.binomtest(n, len(rows)).proportion_ci(method="wilson")
    found = {"P_scs_percent": (100 * low, 100 * high)}
    for name, column in OF_SUCCESSFUL.items():
        x = np.array([row[column] for row in rows if row["success"]])
        half = stats.t.ppf(0.975, n - 1) * x.std(ddof=1) / math.sqrt(n) if n > 1 else math.nan
        found[name] = (m[name] - half, m[name] + half)
    return found


def sectors(rows):
    """Success in percent by the quarter of the workspace the goal is in, from -180 degrees on; NaN for none there."""
    quarter = [int((row["goal_theta"] + math.pi) // (math.pi / 2)) % 4 for row in rows]
    mine = [[row["success"] for row, q in zip(rows, quarter, strict=True) if q == k] for k in range(4)]
    return [100 * sum(won) / len(won) if won else math.nan for won in mine]


def paired(rows, others):
    """Differences rows - others on the same trials, {name: (mean, low, high)}, 95 % bootstrap intervals over trials:
    success in percentage points over all trials, the other metrics over those that both agents succeeded in."""
    from scipy import stats

    pairs = list(zip(rows, others, strict=True))
    both = [(a, b) for a, b in pairs if a["success"] and b["success"]]
    differences = {"P_scs_percent": [100 * (a["success"] - b["success"]) for a, b in pairs]}
    differences |= {name: [a[column] - b[column] for a, b in both] for name, column in OF_SUCCESSFUL.items()}
    found = {}
    for name, d in differences.items():
        low = high = d[0] if d else math.nan
        if len(set(d)) > 1:
            resampled = stats.bootstrap((d,), np.mean, method="percentile", rng=np.random.default_rng(0))
            low, high = resampled.confidence_interval
        found[name] = (float(np.mean(d)) if d else math.nan, float(low), float(high))
    return found


def print_table(results, versus=None):
    """results: {name: rows of evaluation.csv}; versus: the name that the others are compared with."""
    width = max(24, *(len(name) for name in results))
    cell = "{:5.{d}f} [{:.{d}f}, {:.{d}f}]".format
    print(f"{'agent':{width}} trials  {'P_scs %':21}{'T_eff':20}{'R_test':21}{'E_95 cm':19}{'steps':18}failures")
    for name, rows in results.items():
        m, ends = metrics(rows), intervals(rows)
        cells = [(cell(m[key], *ends[key], d=d) if math.isfinite(m[key]) else "  N/A").ljust(w) for key, d, w in CELLS]
        how = [row["failure"] for row in rows if row["failure"]]
        failures = ", ".join(f"{how.count(f)} {f}" for f in sorted(set(how))) or "none"
        print(f"{name:{width}} {len(rows):6d}  {''.join(cells)}{failures}")
    print("[ ]: 95 % interval over trials (P_scs: Wilson; the others over the successful trials: Student)\n")
    print("success % by the goal's quarter, theta in degrees:   [-180, -90)    [-90, 0)     [0, 90)   [90, 180)")
    for name, rows in results.items():
        print(f"{name:{width}}".ljust(51) + "".join(f"{share:12.1f}" for share in sectors(rows)))
    for name in results if versus else ():
        if name != versus:
            print(f"\n{name} less {versus}, the same trials (95 % bootstrap interval over trials):")
            for key, found in paired(results[name], results[versus]).items():
                print(f"  {key:14}{cell(*found, d=2)}")


OF_SUCCESSFUL = {"T_eff": "effort_percent", "R_test": "return", "E_95_cm": "e95_cm", "steps": "length"}
CELLS = [("P_scs_percent", 1, 21), ("T_eff", 1, 20), ("R_test", 2, 21), ("E_95_cm", 2, 19), ("steps", 0, 18)]


def write_csv(path, rows):
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    table.writeheader()
    table.writerows([{k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows])
    logx.atomic_write(path, lambda file: file.write(text.getvalue().encode()))


def write(folder, rows, trajectories):
    """evaluation.csv and trajectories.npz in `folder`."""
    write_csv(folder / "evaluation.csv", rows)
    logx.atomic_write(folder / "trajectories.npz", lambda file: np.savez_compressed(file, **trajectories))


def show(agents, trials, path=None):
    """Test trials of agents, {name: (task, source)}, side by side into a GIF or MP4 at `path`; of one agent in a window
    where it is None."""
    mode = dict(render_mode="rgb_array", width=480, height=360) if path else dict(render_mode="human")
    made = {name: make_agent(*agent, **mode) for name, agent in agents.items()}
    seeds = [FIRST_SEED + i for i in trials]
    if path:
        pid_demo.film(made, path, seeds)
        return
    ((env, act),) = made.values()
    for seed in seeds:
        s, _ = env.reset(seed=seed)
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
    parser.add_argument("--pid", action="store_true", help="the PID demonstrator too")
    parser.add_argument("--task", choices=TASKS, help="with --pid")
    parser.add_argument("--gains", choices=pid_demo.GAINS, help="with --pid (authors)")
    parser.add_argument("--out", type=logx.path, metavar="FOLDER", help="with --pid: where its trials are written")
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=1, help="worker processes")
    parser.add_argument("--versus", type=Path, metavar="RUN", help="print paired differences from this run as well")
    parser.add_argument("--gif", type=logx.path, metavar="FILE", help="film trials instead, the agents side by side")
    parser.add_argument("--mp4", type=logx.path, metavar="FILE",
                        help="the same as a video (pip install imageio imageio-ffmpeg)")  # fmt: skip
    parser.add_argument("--watch", action="store_true", help="trials in PyBullet's window instead")
    parser.add_argument("--show", type=int, nargs="+", metavar="I", help="which trials (0 ... 5; --watch: 0 1 2)")
    flags = parser.parse_args()
    for name in ("trials", "jobs"):
        if getattr(flags, name) < 1:
            parser.error(f"--{name} {getattr(flags, name)}: must be at least 1")
    flags.show = flags.show or [*range(3 if flags.watch else 6)]
    if min(flags.show) < 0:
        parser.error(f"--show {min(flags.show)}: must be at least 0")
    if not (flags.pid or flags.runs):
        parser.error("RUN or --pid --task T: name run folders, or ask for the PID")
    if flags.pid and not flags.task:
        parser.error(f"--pid: needs --task, one of {', '.join(TASKS)}")
    if flags.out and not flags.pid:
        parser.error(f"--out {flags.out}: goes with --pid; a run's trials are written into its own folder")
    for name in ("task", "gains"):
        if getattr(flags, name) and not flags.pid:
            parser.error(f"--{name} {getattr(flags, name)}: goes with --pid; a run says its own")
    flags.gains = flags.gains or "authors"
    film = flags.gif or flags.mp4
    for name in ("gif", "mp4"):
        if getattr(flags, name):
            pid_demo.check_output(parser, name, getattr(flags, name), f".{name}")
    if flags.mp4 and not all(map(importlib.util.find_spec, ("imageio", "imageio_ffmpeg"))):
        parser.error("--mp4: needs imageio and imageio-ffmpeg (pip install imageio imageio-ffmpeg), or use --gif")
    if bool(flags.gif) + bool(flags.mp4) + flags.watch > 1:
        parser.error("--gif, --mp4, --watch: one of them at a time")
    agents = {}
    for folder in [*flags.runs, *([flags.versus] if flags.versus else [])]:
        try:
            agents[str(folder)] = (load_policy(folder).task, folder)
        except ValueError as error:
            parser.error(str(error))
    if flags.pid:
        agents[f"PID, {flags.gains} gains, {flags.task}"] = (flags.task, flags.gains)
    if flags.watch and len(agents) > 1:
        parser.error("--watch: one agent at a time")
    tasks = sorted({task for task, _ in agents.values()})
    if len(tasks) > 1 and (flags.versus or film):
        parser.error(f"--versus, --gif, --mp4: the agents must be of one task, not {' and '.join(tasks)}")
    if film or flags.watch:
        try:
            show(agents, flags.show, film)
        except ValueError as error:
            parser.error(str(error))
        except OSError as error:
            parser.error(f"{film}: cannot be written ({error.strerror or error})")
        if film:
            print(f"wrote {film}")
        return
    results = {}
    for name, (task, source) in agents.items():
        results[name], trajectories = run_trials(task, source, flags.trials, flags.jobs)
        try:
            if isinstance(source, Path) and (source / "evaluation.csv.gz").exists():
                print(f"{name}: a published run, its files stay as they are")
            elif isinstance(source, Path):
                write(source, results[name], trajectories)
            elif flags.out:
                flags.out.mkdir(parents=True, exist_ok=True)
                config = {"task": task, "algo": "pid", "gains": source, "versions": logx.versions()}
                text = json.dumps(config, indent=1).encode()
                logx.atomic_write(flags.out / "config.json", lambda file, text=text: file.write(text))
                write(flags.out, results[name], trajectories)
        except OSError as error:
            parser.error(f"{name}: its trials cannot be written ({error.strerror})")
    print_table(results, str(flags.versus) if flags.versus else None)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
