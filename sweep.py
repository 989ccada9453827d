"""The paper's grid of runs (`sec:results`, data/paper/training_metrics.csv), on this machine or on a Slurm cluster.

    python sweep.py --task p2p --seeds 5 --dry_run                   # the commands only, and what they will cost here
    python sweep.py --task p2p --seeds 5 --jobs 2                    # runs them, two at a time
    python sweep.py --task p2p --recipe robust --columns lambda=1.8 baseline --seeds 2 --epochs 10 --jobs 2
    python sweep.py --status                                         # how far the whole grid is
    python sweep.py --task p2p --seeds 5 --cluster slurm --partition cpu --time 600

A run is one command of ddpg_demoease.py or ppo_demoease.py with `--resume`, and one folder, DATA_DIR/NAME; what it
prints goes to log.txt there. The same sweep started again skips what is finished, goes on with what was begun and
starts what is missing, whatever killed it. Ctrl-C saves all running runs and stops. Columns are called as the paper's
tables vary them: `lambda=1.8`, `demos=160`, `baseline`; what stands behind a lone `--` goes to every run as it is.
On Slurm each run is a job of one array (submitit, requirements-slurm.txt): before its time is up or when it is
preempted it saves its state, is queued again, and goes on.
"""

import argparse
import contextlib
import csv
import fcntl
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

from tqdm import tqdm

import logx

HERE = Path(__file__).resolve().parent
SCRIPTS = {"ddpg": "ddpg_demoease.py", "ppo": "ppo_demoease.py"}
# Epochs and steps an epoch where no flag says otherwise (tab:reward, tab:reward2), and each recipe's symmetry.
LENGTH = {"p2p": (250, 2000), "p2po": (500, 2500), "pnp": (50, 4000)}
SYMMETRY = {"paper": "gas", "robust": "canonical"}  # where --symmetry says nothing
OWN = "task recipe symmetry num_demos lambda_bc seed epochs steps_per_epoch name data_dir resume quiet quick".split()
STOPPED = 130  # exit code of a run that was asked to stop, and saved its state


@dataclass(frozen=True)
class Run:
    """One run: its command and its folder."""

    task: str
    algo: str
    N: int  # N_demos
    folder: Path
    flags: tuple  # of the script, as text
    total: int  # environment steps

    @property
    def command(self):
        return [sys.executable, str(HERE / SCRIPTS[self.algo]), *self.flags, "--resume", "--quiet"]

    def steps(self):
        """Environment steps done, by progress.csv; of these a part may have to be done again."""
        rows = self.rows()
        return int(rows[-1]["env_steps"]) if rows else 0

    def rows(self):
        try:
            with open(self.folder / "progress.csv", newline="") as file:
                rows = list(csv.DictReader(file))
        except OSError:
            return []
        return [row for row in rows if row["seconds"] and row["eval_return"] is not None]  # whole lines only

    def saved_last(self):
        """Whether the checkpoint was saved after the last epoch was logged: for runs that were ended by hand."""
        try:
            saved, logged = (os.stat(self.folder / name).st_mtime_ns for name in ("checkpoint.pt", "progress.csv"))
            return saved >= logged
        except OSError:
            return False

    def state(self):
        """(waiting | queued | running | stopped | failed | done, the last error line where it failed)."""
        try:
            with open(self.folder / "lock") as lock:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return "running", ""
        except OSError:
            pass  # never begun
        if queued(self.folder):
            return "queued", ""
        lines = log_lines(self.folder)
        code = lines[-1].removeprefix(EXIT) if lines and lines[-1].startswith(EXIT) else ""
        if code not in ("", "0", str(STOPPED)):
            said = [line for line in lines[:-1] if line.strip() and not line.startswith(EXIT)]
            return "failed", f"exit code {code}: {said[-1] if said else 'it said nothing'}"
        if self.steps() >= self.total and (code == "0" or self.saved_last()):
            return "done", ""
        return ("stopped" if self.steps() else "waiting"), ""


EXIT = "sweep: exit code "


def log_lines(folder):
    try:
        return (folder / "log.txt").read_text(errors="replace").splitlines()
    except OSError:
        return []


def queued(folder):
    """Whether Slurm still has the job that was submitted for a run."""
    try:
        job = (folder / "slurm_job").read_text()
        return bool(subprocess.run(["squeue", "-h", "-j", job], capture_output=True, text=True).stdout.strip())
    except OSError:  # never submitted, or not on the cluster
        return False


# ---- the grid --------------------------------------------------------------------------------------------------------


def columns(task):
    """The paper's columns of a task, each once: {name: (algo, N_demos, lambda_BC)}."""
    found = {}
    with open(HERE / "data/paper/training_metrics.csv", newline="") as file:
        for row in csv.DictReader(file):
            if row["task"] == task:
                value = {"lambda": row["lambda_bc"], "demos": row["num_demos"], "baseline": ""}[row["sweep"]]
                name = row["sweep"] + f"={value}" * bool(value)
                setting = (row["algo"], int(row["num_demos"]), float(row["lambda_bc"]))
                if setting not in found.values():  # P&P's (400, 15) stands in both of its sweeps
                    found[name] = setting
    return found


def grid(flags):
    """The runs that the flags ask for, in the paper's order, seed by seed."""
    runs = []
    for task in flags.task:
        for name, (algo, N, lam) in columns(task).items():
            if flags.columns and name not in flags.columns:
                continue
            # P2P's "N_demos = 0, lambda = 1" is plain DDPG like the baseline: its seeds are others
            first = flags.first_seed + (100 if (N, lam) == (0, 1) else 0)
            symmetry = flags.symmetry or SYMMETRY[flags.recipe]
            given = dict(symmetry=flags.symmetry, epochs=flags.epochs, steps_per_epoch=flags.steps_per_epoch)
            own = dict(task=task, recipe=flags.recipe, num_demos=N, lambda_bc=f"{lam:g}", data_dir=flags.data_dir)
            own |= {key: value for key, value in given.items() if value}
            changes = [f"steps_per_epoch={flags.steps_per_epoch}"] * bool(flags.steps_per_epoch)
            extra = "=".join(flags.extra).replace("--", "").replace("/", "_")
            changes += [extra if len(extra) <= 80 else f"changes-{zlib.crc32(extra.encode()):08x}"] * bool(extra)
            total = (flags.epochs or LENGTH[task][0]) * (flags.steps_per_epoch or LENGTH[task][1])
            for seed in range(first, first + flags.seeds):
                name = [task, algo, flags.recipe, f"N{N}", f"lambda{lam:g}", symmetry, *changes, f"seed{seed}"]
                own |= dict(seed=seed, name="-".join(name))
                words = [word for key, value in own.items() for word in (f"--{key}", str(value))]
                runs.append(Run(task, algo, N, flags.data_dir / own["name"], (*words, *flags.extra), total))
    return runs


def measured_rate(run):
    """Environment steps a second, updates included, of a short run of the same kind on this machine, alone."""
    with tempfile.TemporaryDirectory() as folder:
        short = ["--name", "rate", "--data_dir", folder, "--epochs", "2", "--eval_every", "0"]
        if run.algo == "ddpg":
            short += ["--steps_per_epoch", "100", "--start_steps", "0", "--update_after", "0"]
        else:
            short += ["--clone_iters", "0"]
        short += ["--num_demos", str(min(run.N, 4))]
        done = subprocess.run(run.command + short, env=environment(), capture_output=True, text=True)
        if done.returncode:  # bad input: said now, before anything is begun
            print(done.stderr.strip(), file=sys.stderr)
            raise SystemExit(done.returncode)
        first, second = replace(run, folder=Path(folder) / "rate").rows()
    return (int(second["env_steps"]) - int(first["env_steps"])) / (float(second["seconds"]) - float(first["seconds"]))


def rates(runs):
    """{run: environment steps a second}, measured once for each task, with and without demonstrations."""
    kinds = {(run.task, run.N > 0): run for run in reversed(runs)}
    measured = {kind: measured_rate(run) for kind, run in tqdm(kinds.items(), "measuring", leave=False, disable=None)}
    return {run: measured[run.task, run.N > 0] for run in runs}


def hours(seconds):
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds / 60:.0f} min"


# ---- this machine ----------------------------------------------------------------------------------------------------


def environment():
    return os.environ | {"OMP_NUM_THREADS": "1"}


def start(run):
    """The run's process; what it prints goes to log.txt."""
    run.folder.mkdir(parents=True, exist_ok=True)
    with open(run.folder / "log.txt", "a") as log:
        return subprocess.Popen(run.command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment())


def ended(run, code):
    with open(run.folder / "log.txt", "a") as log:
        log.write(f"{EXIT}{code}\n")


def run_here(runs, jobs):
    """Runs them, `jobs` at a time, a progress line each. After SIGINT or SIGTERM all save their state and end.

    Returns whether it was stopped so.
    """
    asked, told = [], set()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: asked.append(number))
    waiting, places, active = list(runs), list(range(jobs)), {}
    while active or (waiting and not asked):
        if waiting and places and not asked:
            run, place = waiting.pop(0), places.pop(0)
            line = dict(total=run.total, initial=run.steps(), desc=run.folder.name, unit="step", smoothing=0.02)
            active[run] = start(run), tqdm(position=place, leave=False, disable=None, **line), place
        for run, (process, bar, place) in list(active.items()):
            if asked and run not in told:
                process.terminate()
                told.add(run)
            bar.update(run.steps() - bar.n)
            if process.poll() is not None:
                del active[run]
                places.append(place)
                bar.close()
                ended(run, STOPPED if asked and process.returncode < 0 else process.returncode)
                state, error = run.state()
                tqdm.write(f"{state:8} {run.folder} {error}".rstrip())
        time.sleep(0.2)
    return bool(asked)


# ---- Slurm -----------------------------------------------------------------------------------------------------------


class Job:
    """One run as a job of submitit, which calls it on the node, and `checkpoint` before its time there is up."""

    def __init__(self, run):
        self.run, self.process = run, None

    def __call__(self):
        self.process = start(self.run)
        ended(self.run, self.process.wait())
        if self.process.returncode:
            raise RuntimeError(f"{self.run.folder}: exit code {self.process.returncode}, see log.txt there")

    def checkpoint(self):
        import submitit

        with contextlib.suppress(ProcessLookupError, ChildProcessError):  # it has ended already
            os.kill(self.process.pid, signal.SIGTERM)  # it saves its state
            os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT)  # Popen.wait, interrupted by this, is locked
        return submitit.helpers.DelayedSubmission(Job(self.run))


def submit(runs, flags):
    """Hands the runs to submitit as one job array. Raises ValueError where there is no submitit or no cluster."""
    try:
        import submitit
    except ImportError:
        raise ValueError("submitit is not installed (pip install -r requirements-slurm.txt)") from None
    folder = flags.data_dir / "slurm"
    folder.mkdir(parents=True, exist_ok=True)
    try:
        executor = submitit.AutoExecutor(folder, cluster=flags.cluster, slurm_max_num_timeout=10_000)
        executor.update_parameters(name="demo-ease", timeout_min=flags.time, cpus_per_task=1, mem_gb=flags.mem_gb)
        executor.update_parameters(slurm_partition=flags.partition, slurm_array_parallelism=flags.jobs or 256,
                                   slurm_signal_delay_s=flags.signal_delay,
                                   slurm_additional_parameters={"requeue": True})  # fmt: skip
        with executor.batch():
            jobs = [executor.submit(Job(run)) for run in runs]
    except (RuntimeError, submitit.core.utils.FailedJobError) as error:  # no Slurm here; or it refused
        raise ValueError(" ".join(str(error).split())) from None
    for run, job in zip(runs, jobs, strict=True):
        if flags.cluster == "slurm":
            run.folder.mkdir(parents=True, exist_ok=True)
            (run.folder / "slurm_job").write_text(job.job_id)
        print(f"job {job.job_id}  {run.folder}")


def fail(message):
    print(f"sweep.py: error: {message}", file=sys.stderr)
    return 2


# ---- main ------------------------------------------------------------------------------------------------------------


def parse(argv):
    parser = argparse.ArgumentParser(
        description=__doc__, usage=argparse.SUPPRESS, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", nargs="+", choices=LENGTH, default=list(LENGTH), metavar="TASK",
                        help="p2p, p2po, pnp; all by default")  # fmt: skip
    parser.add_argument("--columns", nargs="+", metavar="COLUMN", help="lambda=X, demos=N, baseline; all by default")
    parser.add_argument("--seeds", type=int, default=5, help="seeds a column (5)")
    parser.add_argument("--first_seed", type=int, default=0)
    parser.add_argument("--recipe", choices=("paper", "robust"), default="paper")
    parser.add_argument("--symmetry", choices=("none", "gas", "so2", "canonical"), help="the recipe's by default")
    parser.add_argument("--epochs", type=int, help="the paper's by default")
    parser.add_argument("--steps_per_epoch", type=int)
    parser.add_argument("--data_dir", type=logx.path, default=Path("data/runs"))
    parser.add_argument("--jobs", type=int, help="runs at a time (1 here, 256 on Slurm)")
    parser.add_argument("--dry_run", action="store_true", help="print the commands and what they cost, and do nothing")
    parser.add_argument("--status", action="store_true", help="print how far each run is")
    parser.add_argument("--cluster", choices=("slurm", "local"), help="submit; local: the same without Slurm")
    parser.add_argument("--partition", help="of Slurm")
    parser.add_argument("--time", type=int, default=600, metavar="MINUTES", help="of a job, before it is queued again")
    parser.add_argument("--mem_gb", type=int, default=4, help="of a job, in GB")
    parser.add_argument("--signal_delay", type=int, default=90, metavar="SECONDS",
                        help="before its time is up a job is told to save its state")  # fmt: skip
    own = argv[: argv.index("--")] if "--" in argv else argv
    flags = parser.parse_args(own)
    flags.extra = argv[len(own) + 1 :]
    for name in ("seeds", "epochs", "steps_per_epoch", "jobs", "time", "mem_gb", "signal_delay"):
        if getattr(flags, name) is not None and getattr(flags, name) < 1:
            parser.error(f"--{name} {getattr(flags, name)}: must be at least 1")
    if flags.time * 60 < flags.signal_delay + 60:  # Slurm may signal a minute early: then there is no job to hear it
        parser.error(f"--time {flags.time}: must be at least --signal_delay, {flags.signal_delay} s, and a minute more")
    if flags.data_dir.exists() and not flags.data_dir.is_dir():
        parser.error(f"--data_dir {flags.data_dir}: is a file, a folder is expected")
    if flags.first_seed < 0:
        parser.error(f"--first_seed {flags.first_seed}: must be at least 0")
    for word in flags.extra:
        if word.removeprefix("--").split("=")[0] in OWN:
            parser.error(f"-- {word}: is sweep.py's own; allowed behind -- are the scripts' other flags")
    known = {name: None for task in flags.task for name in columns(task)}
    for name in flags.columns or ():
        if name not in known:
            parser.error(f"--columns {name}: not a column of {' '.join(flags.task)}, which have {' '.join(known)}")
    return flags


def main(argv=None):
    flags = parse(sys.argv[1:] if argv is None else argv)
    if flags.cluster:
        flags.data_dir = flags.data_dir.absolute()
    runs = grid(flags)
    states = {run: run.state() for run in runs}
    if flags.status:
        for run, (state, error) in states.items():
            rows, left = run.rows(), ""
            if rows and state in ("running", "stopped"):
                left = (run.total - run.steps()) / run.steps() * float(rows[-1]["seconds"])
                left = f"{hours(left)} left"
            print(f"{state:8} {100 * run.steps() / run.total:5.1f} %  {left:12} {run.folder}  {error}".rstrip())
        print(", ".join(f"{[state for state, _ in states.values()].count(name)} {name}"
                        for name in ("waiting", "queued", "running", "stopped", "failed", "done")))  # fmt: skip
        return 0
    todo = [run for run in runs if states[run][0] not in ("done", "running", "queued")]
    rate = rates(todo)
    cost = {run: max(0, run.total - run.steps()) / rate[run] for run in todo}
    for run in runs:
        command = shlex.join(["python", SCRIPTS[run.algo], *run.command[2:]])
        print(f"{states[run][0]:8} {hours(cost[run]) if run in cost else '':>8}  {command}")
    jobs = flags.jobs or 1
    total = sum(cost.values())
    print(f"{len(runs)} runs, {len(todo)} to do: {total / 3600:.1f} core-hours at the rates measured here"
          + f" (about {hours(total / jobs)} with --jobs {jobs})" * (not flags.cluster))  # fmt: skip
    if flags.dry_run or not todo:
        return 0
    if flags.cluster == "local" and len(todo) > os.cpu_count():
        return fail(f"--cluster local: would start all {len(todo)} runs on {os.cpu_count()} cores; use --jobs instead")
    if flags.cluster:
        try:
            submit(todo, flags)
        except ValueError as error:
            return fail(f"--cluster {flags.cluster}: {error}")
        return 0
    if run_here(todo, jobs):
        return STOPPED
    return 0 if all(run.state()[0] == "done" for run in todo) else 1


if __name__ == "__main__":
    sys.exit(main())
