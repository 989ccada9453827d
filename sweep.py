"""The paper's grid of runs (Sec. 5.1), on this machine or on a Slurm cluster.

    python sweep.py --task p2p --dry_run            # the commands, and the cost
    python sweep.py --task p2p --recipe robust --jobs 2       # two at a time
    python sweep.py --task p2p --columns lambda=1.8 demos=80 --seeds 2 \\
        --vary symmetry=none,gas gamma=0.98,0.99        # 16 runs
    python sweep.py --status                        # how far each run is
    python sweep.py --cluster slurm --partition cpu --time 600

Columns are called as the paper's tables vary them: `lambda=1.8`, `demos=160`,
`baseline`. `--vary` adds lists of values for any flag of the scripts, written
as in the names of folders (`hidden_sizes=64x64,128x128`, `mask=q,none`).

A run is one command of ddpg_demoease.py or ppo_demoease.py, in the folder that
this command makes by itself; its output goes to log.txt there. Started again,
the same sweep skips runs that are done or running, goes on with those begun and
starts the rest, whatever killed it. Ctrl-C saves all runs and stops; one that
still records or clones begins anew.
On Slurm each run is a job of one array (requirements-slurm.txt): before its
time is up or when it is preempted it saves its state, is queued again, goes on.
"""

import contextlib
import csv
import fcntl
import importlib
import itertools
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from tqdm import tqdm

import logx
from logx import flag

HERE = Path(__file__).resolve().parent
TASKS = ("p2p", "p2po", "pnp")
SCRIPTS = {"ddpg": "ddpg_demoease", "ppo": "ppo_demoease"}
NOT_VARIED = ("task", "seed", "name", "data_dir", "resume", "quick", "quiet")  # the sweep's own
STOPPED = 130  # exit code of a run that was asked to stop, and saved its state
SAYS = "sweep: "  # how lines of log.txt begin that are the sweep's own
EXIT = SAYS + "exit code "
HELD = "another process is running"  # how a run is refused whose folder is held: begun by a sweep that was killed


@dataclass
class Flags:
    # which runs
    task: tuple[str, ...] = flag(TASKS, "tasks", TASKS)
    columns: tuple[str, ...] | None = flag(None, "lambda=X, demos=N, baseline; all of the task's", metavar="COLUMN")
    vary: tuple[str, ...] | None = flag(None, "values of flags; every combination is run", metavar="FLAG=VALUE,...")
    recipe: str = flag("paper", "the scripts' --recipe", ("paper", "robust"))
    epochs: int | None = flag(None, "the scripts' --epochs; the recipe's", low=1)
    seeds: int = flag(5, "seeds a column", low=1, high=100)
    first_seed: int = flag(0, "the first of them", low=0)
    data_dir: Path = flag(Path("data/runs"), "where run folders lie, from the present folder")
    # what to do
    jobs: int | None = flag(None, "runs at a time; 1 here, 256 on Slurm", low=1)
    nice: int = flag(0, "lower priority of the runs on this machine", low=0, high=19)
    dry_run: bool = flag(False, "print the commands and what they cost, measured by short runs, and train nothing")
    status: bool = flag(False, "print how far each run in data_dir is, and do nothing")
    # on a cluster
    cluster: str | None = flag(None, "submit the runs instead of running them here", ("slurm",))
    partition: str | None = flag(None, "of Slurm", metavar="NAME")
    time: int = flag(600, "of a job, before it is queued again", low=1, metavar="MINUTES")
    mem_gb: int = flag(4, "of a job", low=1, metavar="GB")
    signal_delay: int = flag(90, "before its time is up a job saves its state", low=1, metavar="SECONDS")


# ---- a run -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """One run: its folder, its environment steps, its command, and what decides its speed.

    It goes to Slurm's nodes by value: nothing of logx in it, which may not be importable there.
    """

    folder: Path
    total: int
    words: tuple = ()  # script and flags
    kind: tuple = ()
    clone_iters: int = 0  # none without demonstrations

    @property
    def command(self):
        script, *words = self.words
        return [sys.executable, str(HERE / script), *words, "--resume", "--quiet"]

    def start(self):
        """Its process; what it prints goes to log.txt."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with open(self.folder / "log.txt", "a") as log:
            log.write(f"{SAYS}begins\n")
            log.flush()
            return subprocess.Popen(self.command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def note_end(self, code):
        with open(self.folder / "log.txt", "a") as log:
            log.write(f"{EXIT}{code}\n")

    def text(self, name):
        """Of a file of the folder; empty where there is none."""
        try:
            return (self.folder / name).read_text(errors="replace")
        except OSError:
            return ""

    def rows(self):
        """progress.csv as dicts; columns differ by algorithm. A line that is still being written is left out."""
        text = self.text("progress.csv")
        return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))

    def steps(self):
        """Environment steps done, by progress.csv; of these a part may have to be done again. Raises ValueError."""
        rows = self.rows()
        try:
            return int(rows[-1]["env_steps"]) if rows else 0
        except (LookupError, TypeError, ValueError):
            raise ValueError(f"{self.folder / 'progress.csv'}: no number of env_steps in its last line") from None

    def state(self):
        """(waiting | queued | running | stopped | failed | done, the last line it said where it failed)."""
        try:
            with open(self.folder / "lock") as lock:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return "running", ""
        except OSError:
            pass  # never begun
        ask = ["squeue", "-h", "-j", self.text("slurm_job")]
        if ask[-1] and shutil.which("squeue") and subprocess.run(ask, capture_output=True, text=True).stdout.strip():
            return "queued", ""
        steps, lines = self.steps(), self.text("log.txt").splitlines() or [""]
        code = lines[-1].removeprefix(EXIT) if lines[-1].startswith(EXIT) else ""
        said = [line for line in lines if line.strip() and not line.startswith(SAYS)] or ["it said nothing"]
        logged, saved = (self.folder / name for name in ("progress.csv", "checkpoint.pt"))
        if steps >= self.total and (  # by log.txt, or where it was run by hand
            code == "0" or (saved.exists() and saved.stat().st_mtime_ns >= logged.stat().st_mtime_ns)
        ):
            return "done", ""
        if code not in ("", "0", str(STOPPED)) and HELD not in said[-1]:
            return "failed", f"exit code {code}: {said[-1]}"
        return ("stopped" if steps else "waiting"), ""


# ---- the grid --------------------------------------------------------------------------------------------------------


def columns(task):
    """The paper's columns of a task, each once: {name: (algo, N_demos, lambda_BC)}."""
    with open(HERE / "data/paper/training_metrics.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["task"] == task]
    found = {}
    for row in rows:
        value = {"lambda": "=" + row["lambda_bc"], "demos": "=" + row["num_demos"], "baseline": ""}[row["sweep"]]
        setting = row["algo"], int(row["num_demos"]), float(row["lambda_bc"])
        if setting not in found.values():  # P&P's (400, 15) stands in both of its sweeps
            found[row["sweep"] + value] = setting
    return found


def combinations(vary):
    """Every combination of the values of --vary: a list of {flag: value as text}."""
    values = {}
    for text in vary or ():
        name, equals, given = text.partition("=")
        if not (name and equals) or name in ("help", *NOT_VARIED, *values):
            raise logx.BadInput(f"--vary {text}: must be FLAG=VALUE,... once, and not of {', '.join(NOT_VARIED)}")
        values[name] = given.split(",")
    return [dict(zip(values, combination, strict=True)) for combination in itertools.product(*values.values())]


def as_words(cls, setting):
    """{flag: value as text}, as in a folder's name, as the command line of a script whose flags are `cls`."""
    words = []
    for name, value in setting.items():
        if value == "False":
            words += [] if getattr(cls, name, None) is False else [f"--no-{name}"]
        elif value == "True":
            words += [f"--{name}"]
        else:
            words += [f"--{name}", *(value.split("x") if re.fullmatch(r"\d+(x\d+)+", value) else [value])]
    return words


def grid(flags):
    """The jobs that the flags ask for, in the paper's order, seed by seed, each once. Raises logx.BadInput."""
    jobs = {}
    for task in flags.task:
        chosen = [setting for name, setting in columns(task).items() if name in (flags.columns or [name])]
        made = {}  # {(its column, folder): the values that make it}
        for (algo, N, lam), varied in itertools.product(chosen, combinations(flags.vary)):
            script = importlib.import_module(SCRIPTS[algo])  # here, since torch takes seconds
            setting = {"task": task, "recipe": flags.recipe, "num_demos": f"{N}", "lambda_bc": f"{lam:g}"}
            setting |= {"epochs": f"{flags.epochs}"} if flags.epochs else {}
            words = as_words(script.Flags, setting | varied | {"data_dir": str(flags.data_dir)})
            try:
                asked = logx.parse_flags(script.Flags, "", words)
                # P2P's "N_demos = 0, lambda = 1" is plain DDPG like the baseline: its seeds are others
                first = flags.first_seed + 100 * ((task, asked.num_demos, asked.lambda_bc) == ("p2p", 0, 1))
                found = [script.resolve(replace(asked, seed=seed)) for seed in range(first, first + flags.seeds)]
            except logx.BadInput as error:
                raise logx.BadInput(f"{SCRIPTS[algo]}.py: {error}") from None
            for f in found:
                folder = flags.data_dir / f.name
                before = made.setdefault((algo, N, lam, folder), varied)
                for name in (name for name in varied if varied[name] != before[name]):
                    raise logx.BadInput(
                        f"--vary {name}: {before[name]} and {varied[name]} make the one folder {folder}"
                    )
                command = (f"{SCRIPTS[algo]}.py", *words, "--seed", f"{f.seed}")
                kind = (algo, task, f.recipe, f.variant, min(4, f.num_demos))
                total, clone_iters = f.epochs * f.steps_per_epoch, f.clone_iters * bool(f.num_demos)
                jobs[folder] = Job(folder, total, command, kind, clone_iters)
    return list(jobs.values())


def costs(jobs):
    """{job: seconds to come}, cloning and updates included, by a short run of the same kind here, alone."""
    measured = {}
    for kind, job in tqdm({job.kind: job for job in jobs}.items(), "measuring", leave=False, disable=None):
        algo, *_, demos = kind
        clone_iters = min(job.clone_iters, 200)
        short = ["--epochs", "2", "--eval_every", "0", "--num_demos", f"{demos}"]
        short += ["--clone_iters", f"{clone_iters}"] * bool(clone_iters)
        short += "--steps_per_epoch 200 --update_every 20 --start_steps 0 --update_after 0".split() * (algo == "ddpg")
        with tempfile.TemporaryDirectory() as folder:
            words = (*job.words, *short, "--data_dir", folder, "--name", "rate")
            job = replace(job, folder=Path(folder) / "rate", words=words)
            done = subprocess.run(job.command, capture_output=True, text=True)
            if done.returncode:
                raise logx.BadInput(done.stderr)
            steps, seconds = ([float(row[name]) for row in job.rows()] for name in ("env_steps", "seconds"))
        epoch = seconds[1] - seconds[0]  # the first one has the cloning too
        measured[kind] = epoch / (steps[1] - steps[0]), max(0, seconds[0] - epoch) / max(1, clone_iters)
    cost = {}
    for job in jobs:
        a_step, a_clone_iter = measured[job.kind]
        done = job.steps()
        cost[job] = max(0, job.total - done) * a_step + (0 if done else job.clone_iters * a_clone_iter)
    return cost


def hours(seconds):
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds / 60:.0f} min"


# ---- this machine ----------------------------------------------------------------------------------------------------


def run_here(jobs, at_a_time):
    """Runs them. After SIGINT or SIGTERM all save their state and end. Returns whether it was stopped so."""
    asked, told = [], []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: asked.append(number))
    waiting, active, steps = list(jobs), {}, {job: job.steps() for job in jobs}
    bar = tqdm(total=sum(job.total for job in jobs), initial=sum(steps.values()), unit="step", disable=None)
    while active or (waiting and not asked):
        if waiting and len(active) < at_a_time and not asked:
            job = waiting.pop(0)
            try:
                active[job] = job.start()
            except OSError as error:
                bar.write(f"failed   {job.folder} cannot be written ({error.strerror})")
        if asked and not told:
            told = [process.terminate() for process in active.values()]
        for job, process in list(active.items()):
            if process.poll() is not None:
                del active[job]
                with contextlib.suppress(OSError):  # no space, as the run itself has said
                    job.note_end(STOPPED if asked and process.returncode < 0 else process.returncode)
                state, error = job.state()
                bar.write(f"{state:8} {job.folder} {error}".rstrip())
            steps[job] = job.steps()
        bar.update(sum(steps.values()) - bar.n)
        time.sleep(0.2)
    bar.close()
    return bool(asked)


# ---- Slurm -----------------------------------------------------------------------------------------------------------


class SlurmJob:
    """A Job as submitit's, which calls it on the node, and `checkpoint` before its time there is up."""

    def __init__(self, job):
        self.job, self.process = job, None

    def __call__(self):
        self.process = self.job.start()
        self.job.note_end(self.process.wait())
        if self.process.returncode:
            raise RuntimeError(f"{self.job.folder}: exit code {self.process.returncode}, see log.txt there")

    def checkpoint(self):
        import submitit

        if self.process:  # else it has not begun
            with contextlib.suppress(ProcessLookupError, ChildProcessError):  # it has ended already
                os.kill(self.process.pid, signal.SIGTERM)  # it saves its state
                # Popen.wait, interrupted by this, is locked
                os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT)
        return submitit.helpers.DelayedSubmission(SlurmJob(self.job))


def submit(jobs, flags):
    """Hands the jobs to submitit as one array. Raises logx.BadInput where there is no submitit or no cluster."""
    try:
        import submitit

        folder = flags.data_dir / "slurm"
        folder.mkdir(parents=True, exist_ok=True)
        executor = submitit.AutoExecutor(folder, cluster="slurm", slurm_max_num_timeout=10_000)
        executor.update_parameters(name="demo-ease", timeout_min=flags.time, cpus_per_task=1, mem_gb=flags.mem_gb,
                                   slurm_partition=flags.partition, slurm_array_parallelism=flags.jobs or 256,
                                   slurm_signal_delay_s=flags.signal_delay,
                                   slurm_additional_parameters={"requeue": True})  # fmt: skip
        for job in jobs:
            job.folder.mkdir(parents=True, exist_ok=True)
        with executor.batch():
            submitted = [executor.submit(SlurmJob(job)) for job in jobs]
    except ImportError:
        raise logx.BadInput("--cluster slurm: needs submitit (pip install -r requirements-slurm.txt)") from None
    except (RuntimeError, submitit.core.utils.FailedJobError) as error:  # no Slurm here; or it refused
        raise logx.BadInput(f"--cluster slurm: {error}") from None
    except OSError as error:
        raise logx.BadInput(f"--data_dir: {error.filename}: {error.strerror}; a folder is expected") from None
    for job, its in zip(jobs, submitted, strict=True):
        (job.folder / "slurm_job").write_text(its.job_id)
        print(f"job {its.job_id}  {job.folder}")


# ---- main ------------------------------------------------------------------------------------------------------------


def parse(argv=None):
    """The flags of a command line. Raises logx.BadInput."""
    flags = logx.parse_flags(Flags, __doc__, argv)
    if flags.time * 60 < flags.signal_delay + 60:  # Slurm may signal a minute early: then there is no job to hear it
        raise logx.BadInput(f"--time {flags.time}: must be --signal_delay, {flags.signal_delay} s, and a minute more")
    if os.path.exists(flags.data_dir) and not os.path.isdir(flags.data_dir):
        raise logx.BadInput(f"--data_dir {flags.data_dir}: is a file, a folder is expected")
    known = {name: None for task in flags.task for name in columns(task)}
    for name in flags.columns or ():
        if name not in known:
            raise logx.BadInput(f"--columns {name}: {' '.join(flags.task)} has {' '.join(known)}")
    if flags.epochs and any(text.startswith("epochs=") for text in flags.vary or ()):
        raise logx.BadInput(f"--epochs {flags.epochs}: does not go with --vary epochs")
    for name in ("nice",) if flags.cluster else ("partition", "time", "mem_gb", "signal_delay"):
        if getattr(flags, name) != getattr(Flags, name):
            raise logx.BadInput(f"--{name}: goes with{'out' * bool(flags.cluster)} --cluster")
    if flags.status and (flags.dry_run or flags.cluster):
        raise logx.BadInput("--status: goes without --dry_run and --cluster")
    if flags.cluster:
        flags.data_dir = flags.data_dir.absolute()
    return flags


def print_status(jobs, data_dir):
    """How far each run in data_dir is, of the grid or not, and how many of the grid's are not begun."""
    begun, count = {job.folder: job for job in jobs if os.path.exists(job.folder)}, Counter()
    for folder in dict.fromkeys([*begun, *(file.parent for file in sorted(data_dir.glob("*/config.json")))]):
        try:
            config = {} if folder in begun else json.loads((folder / "config.json").read_text())
            if config.get("algo") == "pid":
                continue  # an evaluation of the demonstrator, no run
            job = begun.get(folder) or Job(folder, int(config["epochs"] * config["steps_per_epoch"]))
            (state, error), rows, to_come = job.state(), job.rows(), ""
            if rows and state in ("running", "stopped"):
                to_come = hours((job.total - job.steps()) / job.steps() * float(rows[-1]["seconds"])) + " to come"
            print(f"{state:8} {100 * job.steps() / job.total:5.1f} %  {to_come:15} {job.folder}  {error}".rstrip())
            count[state] += 1
        except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
            print(f"{folder}: no run's config.json and progress.csv ({logx.one_line(error)})", file=sys.stderr)
    missing = sum(job.folder not in begun for job in jobs)
    print(", ".join(f"{n} {state}" for state, n in sorted(count.items())) or f"{data_dir}: no runs", end="")
    print(f"; of the {len(jobs)} runs asked for, {missing} are not begun")


def main(argv=None):
    flags = parse(argv)
    jobs = grid(flags)
    if flags.status:
        return print_status(jobs, flags.data_dir)
    try:
        states = {job: job.state()[0] for job in jobs}
    except ValueError as error:
        raise logx.BadInput(f"{error}; a run's curve is expected, or remove its folder") from None
    todo = [job for job in jobs if states[job] not in ("done", "running", "queued")]
    cost = costs(todo) if flags.dry_run else {}
    for job in jobs:
        print(f"{states[job]:8} {hours(cost[job]) if job in cost else '':>8}  {shlex.join(['python', *job.words])}")
    total = f": {sum(cost.values()) / 3600:.1f} core-hours by short runs here, recording and evaluations not counted"
    print(f"{len(jobs)} runs, {len(todo)} to do" + total * flags.dry_run)
    if flags.dry_run or not todo:
        return 0
    if flags.cluster:
        return submit(todo, flags)
    try:
        flags.data_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise logx.BadInput(f"--data_dir {flags.data_dir}: {error.strerror}; a folder is expected") from None
    os.nice(flags.nice)
    if run_here(todo, flags.jobs or 1):
        return STOPPED
    return 0 if all(job.state()[0] in ("done", "running") for job in todo) else 1


if __name__ == "__main__":
    logx.run_script(main)
