"""The test study (Sec. 5.2): watch trained agents, and measure them.

    python evaluate.py --list                               # trained agents
    python evaluate.py data/results/NAME --gif agent.gif    # film one, or
    python evaluate.py data/results/NAME --watch            # in a window
    python evaluate.py data/runs/NAME --trials 500 --jobs 2
    python evaluate.py data/runs/NAME --versus data/runs/OTHER
    python evaluate.py --pid --task p2p --gains fast        # the demonstrator

Measuring prints a table and writes NAME/evaluation.csv, one row a trial. With
--first_trial, --start or --horizon it is another study, written to a file of
its own: NAME/evaluation-horizon_600.csv.

P_scs: successful trials, percent. Over the successful ones: T_eff (Eq. 12),
100 * mean norm(tau_hat) / 2, percent of the largest possible; R_test, mean
return; E_95 (Eq. 13), mean norm(e) over the last 5 % of the steps, cm. Trial i
has the same goal for every agent, start and horizon. --list looks in
data/results and data/runs beside this file, and in data/runs of the present
folder, where training writes.
"""

import contextlib
import csv
import fcntl
import gzip
import io
import json
import math
import os
import sys
import time
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import gymnasium
import numpy as np
from tqdm import tqdm

import film
import gas
import logx
import pid_demo
from kinova_env import OBS_DIM, TASKS, grasped, start_posture
from logx import flag

HERE = Path(__file__).resolve().parent
RESULTS, RUNS = HERE / "data/results", (HERE / "data/runs", Path("data/runs"))  # where runs are looked for
FIRST_SEED = 1_000_000  # trial i resets with seed FIRST_SEED + i: far from the seeds that runs usually train with
VALIDATION, UNSEEN = 10_000, 50_000  # trials between these are for choosing; 0 ... 499, and those after, choose nothing
PATHS = 20  # trials whose TCP paths are kept
COLUMNS = ["trial", "success", "failure", "grasped", "length", "return", "effort_percent", "final_error_cm", "e95_cm",
           "goal_theta", "goal_rho", "goal_z"]  # fmt: skip
OF_SUCCESSFUL = {"T_eff": "effort_percent", "R_test": "return", "E_95_cm": "e95_cm", "steps": "length",
                 "final_error_cm": "final_error_cm"}  # {metric: column}  # fmt: skip


@dataclass
class Flags:
    runs: tuple[Path, ...] = flag((), "run folders, or their policy.pt", positional=True, metavar="RUN")
    list: bool = flag(False, "print the trained agents in data/results and data/runs, and how to watch each")
    pid: bool = flag(False, "the PID demonstrator too")
    task: str | None = flag(None, "with --pid", choices=tuple(TASKS))
    gains: str | None = flag(None, "with --pid; authors", choices=tuple(pid_demo.GAINS))
    out: Path | None = flag(None, "with --pid: the folder that its trials are written to", metavar="FOLDER")
    trials: int = flag(500, "how many", low=1)
    first_trial: int = flag(0, f"number of the first; choose on {VALIDATION} to {UNSEEN - 1} only", low=0)
    start: tuple[float, float, float] | None = flag(None, "another start pose, in rad, m, m",
                                                    metavar=("THETA", "RHO", "Z"))  # fmt: skip
    horizon: int | None = flag(None, "steps until a timeout; the task's T", low=1)
    jobs: int = flag(1, "worker processes", low=1)
    versus: Path | None = flag(None, "print the differences from this run too, over the same trials", metavar="RUN")
    gif: Path | None = flag(None, "film trials instead, the agents side by side; FILE.gif, or FILE.mp4 (pip install "
                            "-e '.[video]')", metavar="FILE")  # fmt: skip
    watch: bool = flag(False, "trials in PyBullet's window instead")
    show: tuple[int, ...] | None = flag(None, "numbers of the trials to film (the first 6) or watch (3)", low=0)


# ---- policies --------------------------------------------------------------------------------------------------------


class Policy:
    """A deterministic policy as stored in `policy.pt`: callable, obs (n,) float32 -> action (4,) float32.

    stored: {"task", "symmetry", "sizes": [n, ..., 4], "output": "tanh" | "linear", "weights": {name: tensor}}, and
    perhaps "grasp_input": True where the network has one input more, 1 while the cube is grasped.
    """

    def __init__(self, stored):
        import torch  # here and below: seconds, which tables and figures are spared

        self.task = stored["task"]
        self.symmetry, output = stored["symmetry"], stored["output"]
        if self.symmetry not in gas.SYMMETRIES or output not in ("tanh", "linear"):
            raise ValueError(f"symmetry {self.symmetry}, output {output}")
        self.grasp_input = bool(stored.get("grasp_input"))
        sizes = stored["sizes"]
        if (sizes[0] - self.grasp_input, sizes[-1]) != (OBS_DIM[self.task], 4):
            raise ValueError(f"sizes {sizes} do not fit task {self.task}")
        layers = []
        with torch.device("meta"):  # draws no random numbers: a policy may be made in the middle of a run
            for n_in, n_out in zip(sizes[:-1], sizes[1:], strict=True):
                layers += [torch.nn.Linear(n_in, n_out), torch.nn.ReLU()]
        net = torch.nn.Sequential(*layers[:-1])
        net.load_state_dict(stored["weights"], assign=True)
        if not all(w.dtype == torch.float32 and w.isfinite().all() for w in net.parameters()):
            raise ValueError("weights that are not finite, or not float32")
        self.net = torch.nn.Sequential(net, torch.nn.Tanh() if output == "tanh" else torch.nn.Identity())

    def __call__(self, obs):
        import torch

        s = gas.seen(obs, self.symmetry)
        if self.grasp_input:
            s = np.concatenate((s, np.float32(grasped(s))[..., None]), axis=-1)
        with torch.inference_mode():
            return np.clip(self.net(torch.from_numpy(s)).numpy(), -1, 1)


def pack_policy(flags, net, output):
    """What policy.pt holds of an ActorCritic: see Policy. DDPG's normalisation is folded into the first layer."""
    weights = {name: w.detach().cpu().clone() for name, w in net.mu_net.state_dict().items()}
    if hasattr(net, "s_mean"):
        of_s = weights["0.weight"][:, : OBS_DIM[flags.task]]  # a view: without the input of --grasp_input
        of_s /= net.s_std.cpu()
        weights["0.bias"] -= of_s @ net.s_mean.cpu()
    sizes = [net.mu_net[0].in_features, *flags.hidden_sizes, 4]
    return {"task": flags.task, "symmetry": flags.symmetry, "sizes": sizes, "output": output, "weights": weights,
            "grasp_input": flags.grasp_input}  # fmt: skip


def load_policy(run):
    """The Policy of a run folder or of a `policy.pt`. Raises logx.BadInput with what is wrong with the file."""
    path = Path(run) if Path(run).suffix == ".pt" else Path(run) / "policy.pt"
    stored = logx.load_torch(path)
    try:
        return Policy(stored)
    except (LookupError, RuntimeError, TypeError, ValueError) as error:
        raise logx.BadInput(f"{path}: not a policy of ours ({logx.one_line(error)})") from None


# ---- trials ----------------------------------------------------------------------------------------------------------


class OtherStart(gymnasium.Wrapper):
    """Episodes from another start pose (theta, rho, z), towards the goal that their seed draws without it.

    Where the arm would start in the cube, the cube alone is drawn again; a goal at the start pose stays."""

    def __init__(self, env, start):
        super().__init__(env)
        self.start = start

    def reset(self, *, seed=None, options=None):
        self.env.reset(seed=seed)
        x, y, z = self.unwrapped.goal
        goal = (math.atan2(y, x), math.hypot(x, y), z)
        return self.env.reset(seed=seed, options={"start": self.start, "goal": goal})


def make_agent(task, source, start=None, horizon=None, **render):
    """(test environment, act(obs)) of a source: a run folder or policy.pt, PID gains (a name or triple), or any
    callable obs -> action. Raises logx.BadInput."""
    make = dict(stage="test", max_episode_steps=horizon, disable_env_checker=True)
    env = gymnasium.make(TASKS[task].env_id, **make, **render)
    env = OtherStart(env, start) if start else env
    if callable(source):
        return env, source
    if isinstance(source, tuple) or source in pid_demo.GAINS:
        pid = pid_demo.PID(env, source)
        return env, lambda s: pid.act()
    policy = load_policy(source)
    if policy.task != task:
        raise logx.BadInput(f"{source}: a policy of task {policy.task}, not of {task}")
    return env, policy


def trial(env, act, i):
    """Runs test trial i to its end. act: any obs -> action. Returns its row of evaluation.csv (dict), ||e_t|| in m
    (length + 1,), the path of the TCP in m (length + 1, 3), and where the goal and (NaN on P2P) the cube were at its
    start, in m (2, 3)."""
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
    last = -(-length // 20)  # 5 % of the steps, rounded up
    x, y, z = env.unwrapped.goal
    failure = "" if info["is_success"] else info["collision"] or "timeout"
    row = {"trial": i, "success": int(info["is_success"]), "failure": failure, "grasped": int(info["grasped"]),
           "length": length, "return": total, "effort_percent": 100 * effort / length / 2,  # norm(tau_hat) <= sqrt(4)
           "final_error_cm": 100 * errors[-1], "e95_cm": 100 * sum(errors[-last:]) / last,
           "goal_theta": math.atan2(y, x), "goal_rho": math.hypot(x, y), "goal_z": z}  # fmt: skip
    return row, np.array(errors, dtype=np.float32), np.array(path, dtype=np.float32), np.array(start)


def _trials(numbers, task, source, start, horizon):
    env, act = make_agent(task, source, start, horizon)
    done = [trial(env, act, i) for i in numbers]
    env.close()
    return done


def run_trials(task, source, trials=500, first_trial=0, start=None, horizon=None, jobs=1, quiet=False):
    """Test trials first_trial, first_trial + 1, ... of a source (see make_agent). start: (theta, rho, z) in rad, m, m;
    jobs: processes, on which nothing depends; where there are several the source must pickle.

    Returns the rows of evaluation.csv and the arrays of trajectories.npz: `length`, `success` (trials,), `error` in m,
    every trial's length + 1 values one after another, and of the first PATHS trials `tcp` in m, alike, `goal` and
    `object` as the trial began (n, 3). Raises logx.BadInput."""
    chunks = [range(first_trial, first_trial + trials)[i : i + 10] for i in range(0, trials, 10)]
    work = partial(_trials, task=task, source=source, start=start, horizon=horizon)
    with ProcessPoolExecutor(jobs, get_context("spawn")) if jobs > 1 else contextlib.nullcontext() as pool:
        parts = (pool.map if pool else map)(work, chunks)
        bar = tqdm(parts, total=len(chunks), desc="trials / 10", disable=quiet or None, leave=False)
        rows, errors, tcp, starts = zip(*(one for part in bar for one in part), strict=True)
    goal, cube = np.array(starts[:PATHS]).swapaxes(0, 1)
    trajectories = {"length": np.array([row["length"] for row in rows]), "error": np.concatenate(errors)}
    trajectories |= {"success": np.array([row["success"] for row in rows], dtype=bool)}
    return list(rows), trajectories | {"tcp": np.concatenate(tcp[:PATHS]), "goal": goal, "object": cube}


def while_training(policy, flags):
    """{"eval_success": fraction, "eval_return": mean} of flags.eval_trials validation trials of a stored policy (dict).

    In an environment of its own; changes no random state of the run that calls it."""
    numbers = range(VALIDATION, VALIDATION + flags.eval_trials)
    rows = [row for row, *_ in _trials(numbers, flags.task, Policy(policy), None, flags.max_ep_len)]
    return {f"eval_{name}": float(column(rows, name).mean()) for name in ("success", "return")}


# ---- metrics and their 95 % intervals --------------------------------------------------------------------------------


def column(trials, name):
    """(n,) of a column of evaluation.csv. trials: a pandas DataFrame, or a list of rows (dict)."""
    return np.array(trials[name] if hasattr(trials, "columns") else [row[name] for row in trials], dtype=float)


def metrics(trials):
    """The test metrics (Sec. 5.2, Eq. 12, Eq. 13) of trials (see `column`); NaN where no trial succeeded."""
    won = column(trials, "success") == 1
    means = {m: float(column(trials, name)[won].mean()) if won.any() else math.nan for m, name in OF_SUCCESSFUL.items()}
    return {"P_scs_percent": float(100 * won.mean())} | means


def over_trials(trials):
    """{metric: (low, high)} of one agent's trials: Wilson's for P_scs, Student's t over the successful ones else.

    Says nothing of what another seed would reach."""
    from scipy import stats

    won = column(trials, "success") == 1
    low, high = stats.binomtest(int(won.sum()), len(won)).proportion_ci(method="wilson")
    found = {metric: over_seeds(column(trials, name)[won])[1:] for metric, name in OF_SUCCESSFUL.items()}
    return {"P_scs_percent": (100 * low, 100 * high)} | found


def over_seeds(values):
    """(mean, low, high) of the mean of values (seeds,) by Student's t: a bootstrap of so few would be too narrow. NaN
    values (N/A) are left out; low and high are NaN of a single one."""
    return _student(*_mean(values))


def difference(a, b):
    """(mean of a minus mean of b, low, high) of two groups of seeds by Welch's t; low and high are NaN of a single
    seed, and of seeds that all are the same on both sides."""
    (mean_a, var_a, df_a), (mean_b, var_b, df_b) = _mean(a), _mean(b)
    variance = var_a + var_b or math.nan  # without any spread, nothing is known of what other seeds would do
    df = variance**2 / (var_a**2 / df_a + var_b**2 / df_b) if variance > 0 else 1
    return _student(mean_a - mean_b, variance, df)


def paired(trials, others):
    """{metric: (mean, low, high)} of trials minus others, which must be the same trials, by Student's t over trials.

    P_scs in percentage points over all of them, the other metrics over those that both agents succeeded in. Raises
    ValueError where the trials are not the same."""
    if not np.array_equal(column(trials, "trial"), column(others, "trial")):
        raise ValueError("paired differences need the same trials of both agents")
    success = column(trials, "success") - column(others, "success")
    both = (success == 0) & (column(trials, "success") == 1)
    found = {m: over_seeds((column(trials, c) - column(others, c))[both]) for m, c in OF_SUCCESSFUL.items()}
    return {"P_scs_percent": over_seeds(100 * success)} | found


def _mean(values):
    """(mean, its variance, degrees of freedom) of the values that are not NaN."""
    x = np.asarray(values, dtype=float)
    x = x[~np.isnan(x)]
    n = len(x)
    return x.mean() if n else math.nan, x.var(ddof=1) / n if n > 1 else math.nan, n - 1


def _student(mean, variance, df):
    from scipy import stats  # a second, which a training run need not spend

    half = stats.t.ppf(0.975, df) * math.sqrt(variance)
    return float(mean), float(mean - half), float(mean + half)


# ---- output ----------------------------------------------------------------------------------------------------------

CELLS = {"P_scs_percent": ("P_scs %", 1, 21), "T_eff": ("T_eff %", 1, 19), "R_test": ("R_test", 2, 21),
         "E_95_cm": ("E_95 cm", 2, 19), "steps": ("steps", 0, 0)}  # heading, decimals, width  # fmt: skip


def print_table(results, versus=None):
    """results: {name: rows of evaluation.csv}; versus: the name that the others are compared with. 100 columns."""

    def cells(found):
        texts = []
        for metric, (_, d, width) in CELLS.items():
            mean, low, high = found[metric]
            ends = f"[{low:.{d}f}, {high:.{d}f}]" if low < high else "[-]"  # none of a single trial, or of trials alike
            texts.append((f"{mean:.{d}f} {ends}" if mean == mean else "N/A").ljust(width))
        return "  " + " ".join(texts)

    print("  " + " ".join(heading.ljust(width) for heading, _, width in CELLS.values()))
    for name, rows in results.items():
        ends, how = over_trials(rows), [row["failure"] for row in rows if row["failure"]]
        failures = ", ".join(f"{how.count(f)} {f}" for f in sorted(set(how))) or "no failure"
        print(name, cells({m: (mean, *ends[m]) for m, mean in metrics(rows).items()}), sep="\n")
        print(f"  {len(rows)} trials: {failures}")
    for name in results if versus else ():
        if name != versus:
            print(name, f"  minus {versus}, the same trials:", cells(paired(results[name], results[versus])), sep="\n")
    print("[ ]: 95 % interval over trials: Wilson's of P_scs, else Student's t, over the successful trials")
    if versus:
        print("of differences: Student's t over pairs of trials; all but P_scs of those that both succeeded in")


def study(task, first_trial=0, start=None, horizon=None):
    """What a study's files are called by: "" for the one of Sec. 5.2, else what is not as there."""
    parts = ["start_" + "_".join(f"{x:g}" for x in start)] if start else []
    parts += [f"horizon_{horizon}"] if horizon not in (None, TASKS[task].horizon) else []
    return "-".join(parts + ([f"first_trial_{first_trial}"] if first_trial else []))


def path_of(folder, what=""):
    """The table of a study in `folder`: evaluation.csv, of another study `what` evaluation-<what>.csv."""
    return folder / f"evaluation{what and '-' + what}.csv"


def trials_in(path):
    """Rows of a study's table; 0 where there is none."""
    return len(path.read_text(errors="replace").splitlines()) - 1 if path.is_file() else 0


def is_training(folder):
    """Whether a process holds the run (logx.RunFolder)."""
    try:
        with open(folder / "lock") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # none, as of published runs
        pass
    return False


def write(folder, rows, trajectories, what="", began=math.inf):
    """A study's table in `folder`, of the one of Sec. 5.2 trajectories.npz too. A published or larger one stays; of a
    run that trains, or has since they `began` (time.time()), none is written: its policy is or was not the one that it
    ends with. Raises BadInput."""
    path, policy = path_of(folder, what), folder / "policy.pt"
    published = path.with_name(f"{path.name}.gz")
    for stays, message in ((published.exists(), f"{published}: published, stays as it is"),
                           (trials_in(path) > len(rows), f"{path}: of {trials_in(path)} trials, stays as it is"),
                           (is_training(folder) or policy.exists() and policy.stat().st_mtime > began,
                            f"{folder}: still trains; these trials are not written")):  # fmt: skip
        if stays:
            return print(message)
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    table.writeheader()
    table.writerows([{k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows])
    with pid_demo.writing(path):
        logx.atomic_write(path, text.getvalue())
        if not what:
            logx.atomic_write(folder / "trajectories.npz", lambda file: np.savez_compressed(file, **trajectories))


def show(agents, numbers, path=None, quiet=False, **settings):
    """Trials of agents, {name: (task, source)}, side by side into a GIF or MP4 at `path`; of one agent in a window
    where it is None. settings: start, horizon."""
    settings |= dict(render_mode="rgb_array", width=480, height=360) if path else dict(render_mode="human")
    made = {name: make_agent(*agent, **settings) for name, agent in agents.items()}
    if path:
        with pid_demo.writing(path):
            film.film(made, path, {f"trial {i}": FIRST_SEED + i for i in numbers}, quiet=quiet)
        print(f"wrote {path}")
    else:
        (agent,) = made.values()
        for i in numbers:
            row, *_ = trial(*agent, i)
            print(f"trial {i}: {row['failure'] or 'success'} after {row['length']} steps")
    for env, _ in made.values():
        env.close()


def after_training(folder, task, gains, quiet):
    """The ending of --quick: 100 test trials of the run and of the PID, as a table and files, and agent.gif."""
    gains = gains or "fast"
    agents = {str(folder): folder, f"PID, {gains} gains": gains}
    found = {name: run_trials(task, source, 100, quiet=quiet) for name, source in agents.items()}
    write(folder, *found[str(folder)])
    print_table({name: rows for name, (rows, _) in found.items()})
    show({str(folder): (task, folder)}, range(6), folder / "agent.gif", quiet)


def print_agents():
    """Every policy.pt in RESULTS and RUNS."""
    places = dict.fromkeys(place.resolve() for place in (RESULTS, *RUNS))
    for path in (path for place in places for path in sorted(place.glob("**/policy.pt"))):
        tested = "not tested"
        for name, read in (("evaluation.csv", open), ("evaluation.csv.gz", gzip.open)):
            with (
                contextlib.suppress(OSError, EOFError, LookupError, ValueError, zlib.error),
                read(path.parent / name, "rt") as file,
            ):
                if success := [row["success"] == "1" for row in csv.DictReader(file)]:
                    tested = f"{100 * np.mean(success):.1f} % of {len(success)} test trials"
        print(path.parent.name, f"- {tested}")
        print(f"    {os.path.relpath(sys.executable)} {sys.argv[0]} {os.path.relpath(path.parent)} --watch")
    print("--watch needs a display; --gif agent.gif needs none")


# ---- main ------------------------------------------------------------------------------------------------------------


def check(flags):
    """{name: (task, source)} of what the flags name. Raises logx.BadInput."""
    film.check(flags.gif, flags.watch)
    pid_demo.refuse_useless(
        flags,
        (flags.list, set(vars(flags)) - {"list"}, "--list"),
        (flags.gif or flags.watch, {"trials", "jobs", "out"}, "--gif, --watch"),
        (flags.show, {"first_trial"}, "--show"),
    )
    of_pid = flags.task or flags.gains or flags.out
    for wrong, message in (
        (not (flags.pid or flags.runs or flags.list), "RUN: name run folders (--list prints some), or --pid --task T"),
        (flags.pid and not flags.task, f"--pid: needs --task, one of {', '.join(TASKS)}"),
        (of_pid and not flags.pid, "--task, --gains, --out: go with --pid; a run has its own"),
        (flags.out and flags.out.exists() and not flags.out.is_dir(), f"--out {flags.out}: must be a folder"),
        (flags.versus and flags.versus in flags.runs, f"--versus {flags.versus}: must be another than RUN"),
        (flags.show and not (flags.gif or flags.watch), "--show: goes with --gif or --watch; --first_trial else"),
        (flags.watch and len(flags.runs) + flags.pid + bool(flags.versus) > 1, "--watch: one agent at a time"),
    ):
        if wrong:
            raise logx.BadInput(message)
    if flags.start:
        try:
            start_posture(*flags.start)
        except ValueError as error:
            raise logx.BadInput(f"--{error}") from None
    agents = {str(run): (load_policy(run).task, run) for run in [*flags.runs, flags.versus] if run}
    if flags.pid:
        agents[f"PID, {flags.gains or 'authors'} gains, {flags.task}"] = flags.task, flags.gains or "authors"
    tasks = sorted({task for task, _ in agents.values()})
    if len(tasks) > 1 and (flags.versus or flags.gif):
        raise logx.BadInput(f"--versus, --gif: the agents must be of one task, not {' and '.join(tasks)}")
    if flags.out and (flags.out / "config.json").exists():
        asked = {"task": flags.task, "algo": "pid", "gains": flags.gains or "authors"}
        try:
            there = json.loads((flags.out / "config.json").read_text(encoding="utf-8"))
            others = {name: there.get(name) for name in asked} != asked
        except (OSError, ValueError, AttributeError):
            others = True
        if others:
            raise logx.BadInput(f"--out {flags.out}: holds the config.json of another run; name another folder")
    return agents


def folder_of(source, flags):
    """Where the trials of a policy, or of the PID, are written; None of the PID without --out."""
    if isinstance(source, Path):
        return source.parent if source.suffix == ".pt" else source
    return flags.out


def main():
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # small networks: more threads would wait for each other
    flags = logx.parse_flags(Flags, __doc__)
    agents, results = check(flags), {}
    if flags.list:
        return print_agents()
    settings = dict(start=flags.start, horizon=flags.horizon)
    if flags.gif or flags.watch:
        numbers = flags.show or [flags.first_trial + i for i in range(3 if flags.watch else 6)]
        return show(agents, numbers, flags.gif, **settings)
    for name, (task, source) in agents.items():
        began = time.time()
        found = run_trials(task, source, flags.trials, flags.first_trial, jobs=flags.jobs, **settings)
        folder = folder_of(source, flags)
        if flags.out and source in pid_demo.GAINS and not (folder / "evaluation.csv.gz").exists():
            config = {"task": task, "algo": "pid", "gains": source, "versions": logx.versions()}
            with pid_demo.writing(f"--out {folder}"):
                folder.mkdir(parents=True, exist_ok=True)
                logx.atomic_write(folder / "config.json", json.dumps(config, indent=1))
        results[name] = found[0]
        if folder is not None:
            write(folder, *found, study(task, flags.first_trial, **settings), began)
    print_table(results, str(flags.versus) if flags.versus else None)


if __name__ == "__main__":
    logx.run_script(main)
