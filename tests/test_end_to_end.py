"""Both algorithm scripts as a user runs them, as processes: killed and resumed runs, exit codes, folders, bad input.

Most are forked from a process that has imported torch already, which takes seconds; one test runs them by themselves.
"""

import itertools
import json
import multiprocessing
import os
import random
import resource
import runpy
import signal
import subprocess
import sys
import threading
import time
from dataclasses import fields
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tqdm import tqdm

import kinova_env
import logx
from scripted import SCRIPTS, TINY, checkpoint, curves, rows_of

torch.optim.Adam([torch.zeros(1)])  # imports as much again, here once for all processes that are forked
ROOT = Path(kinova_env.__file__).parent
DEMONSTRATED = dict(num_demos=2, lambda_bc=None, recipe="robust", clone_iters=20, epochs=6)
AGENTS = {  # the last episodes of P2P-O collide, those of P&P grasp
    "ddpg": TINY[SCRIPTS["ddpg"]] | DEMONSTRATED | dict(task="p2po", act_noise=2.0, update_every=10),
    "ppo": TINY[SCRIPTS["ppo"]] | DEMONSTRATED | dict(task="pnp", log_std=0.0),
}
NEVER_ENDS = dict(epochs=1_000_000)


def argv_of(algo, folder, **changes):
    """The command line of a tiny run in `folder`."""
    argv = [str(ROOT / f"{algo}_demoease.py"), "--data_dir", str(folder.parent), "--name", folder.name]
    for name, value in (AGENTS[algo] | changes).items():
        if value is True:
            argv.append(f"--{name}")
        elif value is not None:
            argv += [f"--{name}", *map(str, value if isinstance(value, tuple) else (value,))]
    return argv


# ---- processes -------------------------------------------------------------------------------------------------------


def child(argv, out, err, before):
    """In a process of its own: does `before`, runs the script as a command, then does what `before` returned."""
    for number, path in ((0, os.devnull), (1, out), (2, err)):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
    os.chdir(Path(out).parent)
    sys.stdout, sys.stderr, sys.argv = open(1, "w"), open(2, "w"), argv  # noqa: SIM115
    tqdm.set_lock(threading.RLock())  # its own is a semaphore that outlives a kill -9
    after = before() or nothing
    try:
        runpy.run_path(argv[0], run_name="__main__")
    finally:
        sys.setprofile(None)
        after()
        sys.stdout.flush()
        sys.stderr.flush()


def nothing():
    pass


def near():
    """The arm starts close to the cube, so that short episodes collide or grasp."""
    draw = kinova_env.KinovaEnv._draw

    def drawn(self, options):
        posture, goal, cube = draw(self, options)
        if self.stage == "train" and cube is not None:
            cube = (np.pi / 4 + 0.085, 0.52, 0.42) if self.row.cube == "object" else (np.pi / 4, 0.57, 0.42)
            goal = (-np.pi / 2, 0.5, 0.4)
        return posture, goal, cube

    kinova_env.KinovaEnv._draw = drawn


def from_its_beginning(look):
    """Calls look(frame, event, arg) at each call and return, of Python and of C, once a run has begun."""
    begin = logx.RunFolder.begin
    logx.RunFolder.begin = lambda *args: begin(*args) or sys.setprofile(look)


def near_and_count(file):
    """Writes how many of those moments there were."""
    near()
    moments = itertools.count()
    from_its_beginning(lambda *args: next(moments))
    return lambda: Path(file).write_text(str(next(moments)))


def near_and_kill(moment):
    """kill -9 at the moment-th."""
    near()
    moments = itertools.count()
    from_its_beginning(lambda *args: os.kill(os.getpid(), signal.SIGKILL) if next(moments) == moment else None)


def little_room(size):
    """No file may be longer than so many bytes, as on a full disk."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


class Runs:
    """Starts scripts in `folder`."""

    def __init__(self, folder):
        self.folder, self.context = folder, multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(["test_end_to_end", "evaluate"])

    def start(self, argv, before=nothing):
        streams = [str(self.folder / f"{time.monotonic_ns()}.{name}") for name in ("out", "err")]
        process = self.context.Process(target=child, args=(argv, *streams, before))
        process.start()
        return SimpleNamespace(process=process, streams=streams)

    def end(self, run):
        """The exit code, minus the signal that killed it, and what it wrote."""
        run.process.join(120)
        out, err = (Path(stream).read_text() for stream in run.streams)
        if run.process.exitcode:
            print(f"exit code {run.process.exitcode}: {err.strip()}")
        return SimpleNamespace(code=run.process.exitcode, out=out, err=err)

    def __call__(self, argv, before=nothing):
        return self.end(self.start(argv, before))


@pytest.fixture(scope="session")
def runs(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(map(str, (ROOT, ROOT / "tests"))))  # of the process that forks
        patch.setenv("CUDA_VISIBLE_DEVICES", "")
        runs = Runs(tmp_path_factory.mktemp("runs"))
        runs([str(ROOT / "ddpg_demoease.py"), "--help"])
    return runs


@pytest.fixture(scope="session")
def unbroken(runs, tmp_path_factory):
    """unbroken(algo): the folder of its run, never stopped, and how many moments it had."""
    found = {}

    def of(algo):
        if algo not in found:
            folder = tmp_path_factory.mktemp("unbroken") / "run"
            done = runs(argv_of(algo, folder), partial(near_and_count, str(folder.parent / "moments")))
            assert (done.code, done.err) == (0, "")
            found[algo] = folder, int((folder.parent / "moments").read_text())
        return found[algo]

    return of


def wait_for(condition, process):
    until = time.monotonic() + 100
    while not condition():
        assert process.is_alive() and time.monotonic() < until
        time.sleep(0.01)


def is_one_line(text):
    return text.count("\n") == 1 and text.endswith("\n")


# ---- killed and stopped ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algo", SCRIPTS)
def test_a_run_killed_at_random_moments_and_resumed_equals_one_never_killed(runs, unbroken, tmp_path, algo):
    (whole, moments), folder, draw = unbroken(algo), tmp_path / "run", random.Random(algo)
    for _ in range(3):
        moment = int(draw.uniform(0.1, 0.33) * moments)
        killed = runs(argv_of(algo, folder, resume=True), partial(near_and_kill, moment))
        assert killed.code == -signal.SIGKILL
    done = runs(argv_of(algo, folder, resume=True), near)
    assert (done.code, done.err) == (0, "") and curves(folder) == curves(whole)


def test_those_runs_collide_with_the_cube_and_grasp_it(unbroken):
    assert "cube" in {row["collision"] for row in rows_of(unbroken("ddpg")[0] / "episodes.csv")}
    assert max(float(row["return"]) for row in rows_of(unbroken("ppo")[0] / "episodes.csv")) > 1


@pytest.mark.parametrize("algo", SCRIPTS)
def test_sigterm_is_130_with_the_state_saved_and_until_then_the_folder_is_held(runs, tmp_path, algo):
    folder = tmp_path / "run"
    run = runs.start(argv_of(algo, folder, **NEVER_ENDS))
    wait_for(lambda: (folder / "checkpoint.pt").exists(), run.process)
    second = runs(argv_of(algo, folder, resume=True, **NEVER_ENDS))
    assert second.code == 2 and is_one_line(second.err) and "another process" in second.err
    os.kill(run.process.pid, signal.SIGTERM)
    done = runs.end(run)
    assert done.code == 130 and is_one_line(done.err) and "go on with --resume" in done.err
    assert f"stopped at step {checkpoint(folder)['t']}," in done.err


@pytest.mark.parametrize("algo, rate", [("ddpg", "q_lr"), ("ppo", "vf_lr")])
def test_nan_is_3_and_one_line(runs, tmp_path, algo, rate):
    done = runs(argv_of(algo, tmp_path / "run", **{rate: 1e30}))
    assert done.code == 3 and is_one_line(done.err) and "learning rates" in done.err


@pytest.mark.parametrize("algo", SCRIPTS)
def test_a_full_disk_is_2_and_one_line_and_the_run_goes_on_later(runs, unbroken, tmp_path, algo):
    folder = tmp_path / "run"
    full = runs(argv_of(algo, folder), partial(little_room, 30_000))
    assert full.code == 2 and is_one_line(full.err) and f"cannot write {folder}" in full.err
    assert not list(folder.glob("*.part"))
    assert runs(argv_of(algo, folder, resume=True), near).code == 0


# ---- what a run leaves -----------------------------------------------------------------------------------------------


def test_the_script_by_itself_gives_the_run_that_is_forked_here(runs, tmp_path):
    forked, alone = (tmp_path / name / "run" for name in ("forked", "alone"))
    assert runs(argv_of("ddpg", forked, epochs=2)).code == 0
    argv = [sys.executable, *argv_of("ddpg", alone, epochs=2)]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (0, "") and curves(alone) == curves(forked)


@pytest.mark.parametrize("algo", SCRIPTS)
def test_a_run_folder_holds_settings_curves_checkpoint_and_policy(unbroken, algo):
    folder, script = unbroken(algo)[0], SCRIPTS[algo]
    names = {path.name for path in folder.iterdir()}
    assert names - {"lock"} == {"config.json", "episodes.csv", "progress.csv", "checkpoint.pt", "policy.pt"}
    for name in ("checkpoint.pt", "policy.pt"):
        assert isinstance(torch.load(folder / name, weights_only=True), dict)
    config = json.loads((folder / "config.json").read_text())
    assert {field.name for field in fields(script.Flags)} <= set(config) and config["algo"] == algo
    assert Path(config["command"][0]).name == f"{algo}_demoease.py" and "--hidden_sizes" in config["command"]
    assert {"python", "torch", "numpy", "gymnasium", "git_commit", "cpu"} <= set(config["versions"])
    assert {"pybullet", "pybullet-arm64"} & set(config["versions"])  # the package or its fork
    episodes, progress = rows_of(folder / "episodes.csv"), rows_of(folder / "progress.csv")
    assert list(episodes[0]) == "episode,env_steps,return,length,success,collision".split(",")
    first = "epoch,env_steps,demo_env_steps,seconds,EpRet,EpLen,Success".split(",")
    assert list(progress[0]) == [*first, *script.MEASURED, "eval_success", "eval_return"] and len(progress) == 6
    assert np.cumsum([int(row["length"]) for row in episodes]).tolist() == [int(row["env_steps"]) for row in episodes]


@pytest.mark.parametrize("algo", SCRIPTS)
def test_a_run_that_is_not_quiet_shows_a_line_an_epoch(runs, tmp_path, algo):
    done = runs(argv_of(algo, tmp_path / "run", quiet=None, epochs=2))
    lines = done.out.splitlines()
    assert done.code == 0 and len(lines) == 4 and "mask_fraction" in lines[1]
    assert [line.split()[1] for line in lines[2:]] == ["1", "2"]


@pytest.mark.parametrize("algo", SCRIPTS)
def test_help_names_every_flag_and_fits_80_columns(runs, algo):
    done = runs([str(ROOT / f"{algo}_demoease.py"), "--help"])
    assert done.code == 0 and max(map(len, done.out.splitlines())) <= 80
    assert all(f"--{field.name}" in done.out for field in fields(SCRIPTS[algo].Flags) if field.metadata)


# ---- bad command lines -----------------------------------------------------------------------------------------------

BAD = {  # one a rule: what is added to a good command line, and what the one line must say
    "no such flag, but one like it": ("--batch-size 3", "--batch-size: no such flag; did you mean --batch_size?"),
    "an abbreviation": ("--gam 0.9", "--gam"),
    "not a number": ("--epochs many", "--epochs"),
    "no value": ("--hidden_sizes", "--hidden_sizes"),
    "out of range": ("--epochs 0", "--epochs 0: must be at least 1"),
    "not finite": ("--gamma nan", "--gamma nan"),
    "not a choice": ("--symmetry so3", "--symmetry"),
    "not a folder's name": ("--name ..", "--name '..'"),
    "a folder that cannot be": (f"--data_dir {Path(__file__)}/deeper", "--data_dir"),
    "no such file": ("--demos nowhere.npz", "nowhere.npz: no such file"),
    "not a demonstration file": (f"--demos {Path(__file__)}", Path(__file__).name),
    "no run's folder": ("--resume nowhere", "--resume nowhere: must be a run's folder"),
    "no GPU here": ("--device cuda", "--device cuda"),
}


@pytest.mark.parametrize("rule", BAD)
def test_a_bad_command_line_is_2_and_one_line_and_leaves_nothing_behind(runs, tmp_path, rule):
    words, says = BAD[rule]
    done = runs([*argv_of("ddpg", tmp_path / "run"), *words.split()])
    assert done.code == 2 and is_one_line(done.err) and says in done.err and not done.out
    assert done.err.startswith("ddpg_demoease.py: error: ") and not list(tmp_path.iterdir())
