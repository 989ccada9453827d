"""Both algorithm scripts as a user runs them: whole runs, killed and resumed ones, folders, exit codes, bad input.

The scripts run as processes of their own, forked from one that has already imported torch (ten times faster).
"""

import csv
import json
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

import ddpg_demoease as ddpg
import pid_demo
import ppo_demoease as ppo

ROOT = Path(ddpg.__file__).parent
EPOCH, STEPS = 40, 240
TINY = ["--hidden_sizes", 16, 16, "--epochs", 6, "--steps_per_epoch", 40, "--max_ep_len", 28, "--num_demos", 2]
TINY += ["--gains", "fast", "--start_steps", 20, "--update_after", 70, "--update_every", 10, "--replay_size", 350]
TINY += ["--batch_size", 32, "--demo_batch_size", 32, "--eval_every", 0, "--checkpoint_every", 1, "--quiet"]
TINY_PPO = ["--hidden_sizes", 16, 16, "--epochs", 6, "--steps_per_epoch", 40, "--max_ep_len", 28, "--num_demos", 4]
TINY_PPO += ["--gains", "fast", "--train_iters", 3, "--batch_size", 32, "--demo_batch_size", 32, "--eval_every", 0]
TINY_PPO += ["--checkpoint_every", 1, "--quiet"]
AGENTS = {
    "so2": ["--recipe", "robust", "--symmetry", "so2"],
    "canonical": ["--recipe", "robust"],
    "plain": ["--num_demos", "0", "--lambda_bc", "0"],
    "p2po": ["--task", "p2po", "--recipe", "robust", "--act_noise", 2],
    "ppo paper": ["--task", "pnp", "--demos_per_epoch", 1],
    "ppo robust": ["--task", "pnp", "--recipe", "robust", "--clone_iters", 20],
    "ppo so2": ["--task", "p2po", "--recipe", "robust", "--symmetry", "so2", "--clone_iters", 0, "--log_std", 1],
    "ppo plain": ["--task", "pnp", "--num_demos", "0", "--lambda_bc", "0"],
}
DDPG = ["so2", "canonical", "plain", "p2po"]
# Short episodes that grasp or collide: a world in which the arm starts close to the cube.
NEAR = """
import kinova_env, math
def draw(self, options, draw=kinova_env.KinovaEnv._draw):
    posture, goal, cube = draw(self, options)
    if self.stage != "train" or cube is None:
        return posture, goal, cube
    cube = (math.pi / 4 + 0.085, 0.52, 0.42) if self.row.cube == "object" else (math.pi / 4, 0.57, 0.42)
    return posture, (-math.pi / 2, 0.5, 0.4), cube
kinova_env.KinovaEnv._draw = draw
"""
EPISODES = "episode,env_steps,return,length,success,collision"
PROGRESS = ("epoch,env_steps,demo_env_steps,seconds,EpRet,EpLen,Success,L_O,L_BC,L_C,L_A,mask_fraction,Q_mean,Q_max,"
            "pretanh_own,pretanh_demo,bc_relative_error,eval_success,eval_return")  # fmt: skip

SERVER = """
import json, os, runpy, sys, traceback
sys.path.insert(0, sys.argv[1])
import torch, ddpg_demoease, evaluate
torch.set_num_threads(1)
flags = ddpg_demoease.complete(ddpg_demoease.Flags(hidden_sizes=(4,)))
ddpg_demoease.Learner(flags[0] if isinstance(flags, tuple) else flags, 22)  # torch imports more here
for line in sys.stdin:
    job = json.loads(line)
    if "pid" in job:
        pid, status = os.waitpid(job["pid"], os.WNOHANG)
        print(os.waitstatus_to_exitcode(status) if pid else "null", flush=True)
        continue
    pid = os.fork()
    if pid:
        print(pid, flush=True)
        continue
    code = 1
    try:
        for number, path in enumerate((os.devnull, job["out"], job["err"])):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        os.chdir(job["cwd"])
        sys.argv = job["argv"]
        exec(job["first"])
        runpy.run_path(sys.argv[0], run_name="__main__")
        code = 0
    except SystemExit as stopped:
        code = stopped.code or 0
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
"""


class Process:
    """A script that runs on its own; `first` is done in it before the script."""

    def __init__(self, server, folder, argv, first):
        self.server, self.code = server, None
        name = f"{time.monotonic_ns()}"
        self.files = {stream: folder / f"{name}.{stream}" for stream in ("out", "err")}
        argv = [str(ROOT / argv[0]), *map(str, argv[1:])]
        paths = {stream: str(path) for stream, path in self.files.items()}
        for path in self.files.values():
            path.touch()  # it may be killed before it has opened them
        self.pid = server.ask(argv=argv, cwd=str(folder), first=first, **paths)

    def poll(self):
        if self.code is None:
            self.code = self.server.ask(pid=self.pid)
        return self.code

    def send(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def wait(self):
        """The exit code; minus the signal that killed it."""
        until = time.monotonic() + 200
        while self.poll() is None:
            if time.monotonic() > until:
                os.kill(self.pid, signal.SIGKILL)
                raise AssertionError("the script does not end")
            time.sleep(0.005)
        if self.code:
            print(f"exit code {self.code}: {self.err.strip()}")  # pytest -rP shows what each case printed
        return self.code

    @property
    def out(self):
        return self.files["out"].read_text()

    @property
    def err(self):
        """Standard error, without what PyBullet prints there when it is imported."""
        lines = self.files["err"].read_text().splitlines(keepends=True)
        return "".join(line for line in lines if not line.startswith("pybullet build time"))


class Server:
    def __init__(self, folder):
        self.folder = folder
        environment = os.environ | {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen([sys.executable, "-c", SERVER, ROOT], stdin=subprocess.PIPE, text=True,
                                        stdout=subprocess.PIPE, env=environment, cwd=folder)  # fmt: skip

    def ask(self, **job):
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def start(self, *argv, first=""):
        return Process(self, self.folder, argv, first)

    def run(self, *argv, first=""):
        process = self.start(*argv, first=first)
        process.wait()
        return process


@pytest.fixture(scope="session")
def server(tmp_path_factory):
    server = Server(tmp_path_factory.mktemp("server"))
    yield server
    server.process.stdin.close()
    server.process.wait(60)


def argv_of(folder, *flags):
    """The command line of a tiny run; PPO's where the flags are those of an agent of its own."""
    ppo = any(list(flags[: len(own)]) == own for agent, own in AGENTS.items() if agent.startswith("ppo"))
    script = ["ppo_demoease.py", *TINY_PPO] if ppo else ["ddpg_demoease.py", *TINY]
    return [*script, *flags, "--data_dir", folder.parent, "--name", folder.name]


@pytest.fixture(scope="session")
def unbroken(server, tmp_path_factory):
    """unbroken(agent): the folder of its run, never stopped."""
    folders = {}

    def folder_of(agent):
        if agent not in folders:
            folder = tmp_path_factory.mktemp("unbroken") / "run"
            process = server.run(*argv_of(folder, *AGENTS[agent]), first=NEAR)
            assert process.code == 0 and process.err == "", process.err
            folders[agent] = folder
        return folders[agent]

    return folder_of


def rows_of(path):
    return list(csv.DictReader(path.open()))


def curves(folder):
    """(episodes.csv, progress.csv without its wall-clock column, policy.pt): what equal runs share byte by byte."""
    progress = [line.split(",") for line in (folder / "progress.csv").read_text().split("\n")]
    for row in progress:
        row[3:4] = []
    return (folder / "episodes.csv").read_bytes(), progress, (folder / "policy.pt").read_bytes()


def files(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def steps_done(folder):
    """Environment steps by the last whole row of episodes.csv; -1 before the run has begun."""
    if not (folder / "config.json").exists() or not (folder / "episodes.csv").exists():
        return -1
    lines = (folder / "episodes.csv").read_text().split("\n")[1:-1]
    return int(lines[-1].split(",")[1]) if lines else 0


SLOWLY = """
import kinova_env, time
def step(self, action, step=kinova_env.KinovaEnv.step):
    time.sleep(0.002)
    return step(self, action)
kinova_env.KinovaEnv.step = step
"""


def stop(server, folder, flags, steps, number, delay=0.0):
    """Starts a run or resumes it, sends it this signal `delay` seconds after its curve got to `steps`; its process."""
    before = folder.parent / f"{folder.name} before"
    for _ in range(5):
        shutil.rmtree(before, ignore_errors=True)
        if folder.exists():
            shutil.copytree(folder, before)
        process = server.start(*argv_of(folder, *flags, "--resume"), first=SLOWLY + NEAR)
        while process.poll() is None and steps_done(folder) < steps:
            time.sleep(0.002)
        time.sleep(delay)
        process.send(number)
        if process.wait() != 0:
            break
        shutil.rmtree(folder)  # it came to its end before a busy machine let us stop it: once more, from where it was
        if before.exists():
            shutil.copytree(before, folder)
        delay = 0
    shutil.rmtree(before, ignore_errors=True)
    return process


# ---- killed, interrupted, resumed ------------------------------------------------------------------------------------


@pytest.mark.parametrize("agent", ["so2", "p2po", "ppo paper", "ppo robust"])
def test_a_run_killed_at_five_moments_and_resumed_equals_one_never_killed(server, unbroken, tmp_path, agent):
    folder, draw = tmp_path / "run", random.Random(agent)
    for part in range(5):
        moment = (part + draw.random()) / 5 * 0.85 * STEPS
        killed = stop(server, folder, AGENTS[agent], moment, signal.SIGKILL, delay=draw.uniform(0, 0.08))
        assert killed.code == -signal.SIGKILL
    last = server.run(*argv_of(folder, *AGENTS[agent], "--resume"), first=NEAR)
    assert last.code == 0 and last.err == ""
    assert curves(folder) == curves(unbroken(agent))


@pytest.mark.parametrize("agent", ["p2po", "ppo so2"])
def test_those_runs_have_collisions_with_the_cube_in_their_episodes(unbroken, agent):
    assert "cube" in {row["collision"] for row in rows_of(unbroken(agent) / "episodes.csv")}


@pytest.mark.parametrize("agent", ["ppo paper", "ppo robust"])
def test_those_runs_have_grasps_in_their_episodes(unbroken, agent):
    assert max(float(row["return"]) for row in rows_of(unbroken(agent) / "episodes.csv")) > 1


KILL_AT_RENAME = """
import itertools, os
def replace(a, b, real=os.replace, count=itertools.count(1)):
    if next(count) == {}:
        os.kill(os.getpid(), 9)
    real(a, b)
os.replace = replace
"""


@pytest.mark.parametrize("rename", [1, 2, 3], ids=["config.json", "checkpoint.pt", "policy.pt"])
def test_a_run_killed_just_before_a_file_is_in_place_resumes_alike(server, unbroken, tmp_path, rename):
    folder = tmp_path / "run"
    killed = server.run(*argv_of(folder, *AGENTS["plain"]), first=KILL_AT_RENAME.format(rename))
    assert killed.code == -signal.SIGKILL
    whole = [name for name in ("config.json", "checkpoint.pt", "policy.pt") if (folder / name).exists()]
    assert whole == ["config.json", "checkpoint.pt", "policy.pt"][: rename - 1]
    last = server.run(*argv_of(folder, *AGENTS["plain"], "--resume"))
    assert last.code == 0 and last.err == "" and curves(folder) == curves(unbroken("plain"))


KILL_IN_WRITE = """
import io, itertools, os, torch
def save(state, file, real=torch.save, count=itertools.count(1)):
    whole = io.BytesIO()
    real(state, whole)
    if next(count) == {}:
        file.write(whole.getvalue()[:int({} * len(whole.getvalue()))])
        file.flush()
        os.kill(os.getpid(), 9)
    file.write(whole.getvalue())
torch.save = save
"""


@pytest.mark.parametrize("agent", ["plain", "ppo plain"])
def test_a_run_killed_in_the_middle_of_writing_its_files_resumes_alike(server, unbroken, tmp_path, agent):
    """KILLS=100 in the environment tries more moments than five."""
    draw, folder = random.Random(agent), tmp_path / "run"
    for n in range(int(os.environ.get("KILLS", 5))):
        if n % 5 == 0:
            shutil.rmtree(folder, ignore_errors=True)
        first = NEAR + KILL_IN_WRITE.format(draw.randint(1, 3), draw.random())
        process = server.run(*argv_of(folder, *AGENTS[agent], "--resume"), first=first)
        assert process.code == -signal.SIGKILL or (n % 5 and process.code == 0)
        if n % 5 == 4:
            last = server.run(*argv_of(folder, *AGENTS[agent], "--resume"), first=NEAR)
            assert last.code == 0 and last.err == ""
            assert curves(folder) == curves(unbroken(agent))


NO_ROOM = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0}))
"""


def refused_for_want_of_room(process, folder):
    return (process.code == 2 and process.err.count("\n") == 1 and "--data_dir" in process.err
            and str(folder) in process.err and not list(folder.glob("*.part")))  # fmt: skip


@pytest.mark.parametrize("bytes", [1500, 4000, 40_000])
def test_a_run_that_may_not_write_more_says_so_and_goes_on_later_from_its_last_checkpoint(
    server, unbroken, tmp_path, bytes
):
    folder, agent = tmp_path / "run", AGENTS["plain"]
    cut = server.run(*argv_of(folder, *agent), first=NO_ROOM.format(bytes))
    assert refused_for_want_of_room(cut, folder)
    assert server.run(*argv_of(folder, *agent, "--resume")).code == 0
    assert curves(folder) == curves(unbroken("plain"))


@pytest.mark.root
@pytest.mark.parametrize("size", ["12k", "60k", "100k"])
def test_a_full_disk_and_a_read_only_one_are_one_line_and_lose_nothing(server, unbroken, tmp_path, size):
    disk, agent = tmp_path / "disk", AGENTS["plain"]
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", disk], check=True)
    try:
        assert refused_for_want_of_room(server.run(*argv_of(disk / "run", *agent)), disk / "run")
        before = files(disk / "run")
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        refused = server.run(*argv_of(disk / "run", *agent, "--resume"))
        assert refused.code == 2 and refused.err.count("\n") == 1 and "--data_dir" in refused.err
        assert files(disk / "run") == before
        subprocess.run(["mount", "-o", "remount,rw,size=100m", disk], check=True)
        assert server.run(*argv_of(disk / "run", *agent, "--resume")).code == 0
        assert curves(disk / "run") == curves(unbroken("plain"))
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_an_interrupted_run_says_so_with_130_and_resumes_alike(server, unbroken, tmp_path):
    folder, agent = tmp_path / "run", "so2"
    process = stop(server, folder, AGENTS[agent], 90, signal.SIGINT, delay=0.02)
    assert process.code == 130 and process.err.count("\n") == 1 and "--resume" in process.err
    t = json.loads(torch.load(folder / "checkpoint.pt", weights_only=True)["loop"])["t"]
    assert 90 <= t < STEPS and (folder / "policy.pt").exists()
    assert server.run(*argv_of(folder, *AGENTS[agent], "--resume")).code == 0
    assert curves(folder) == curves(unbroken(agent))


def test_an_interrupt_while_demonstrations_are_recorded_is_no_crash(server, tmp_path):
    first = "import os, pid_demo, signal\nsignal.signal(2, signal.default_int_handler)\n"  # a shell's & had it ignored
    first += "pid_demo.record = lambda *args, **kwargs: os.kill(os.getpid(), 2) or {}"
    process = server.run(*argv_of(tmp_path / "run", *AGENTS["so2"]), first=first)
    assert process.code == 130 and "Traceback" not in process.err
    assert server.run(*argv_of(tmp_path / "run", *AGENTS["so2"], "--resume", "--epochs", 1)).code == 0


def test_a_folder_of_a_run_is_refused_without_resume_and_left_untouched(server, unbroken):
    folder = unbroken("plain")
    before = files(folder)
    process = server.run(*argv_of(folder, *AGENTS["plain"]))
    assert process.code == 2 and process.err.count("\n") == 1
    assert "--resume" in process.err and "--name" in process.err and files(folder) == before


@pytest.mark.parametrize("flags", [[], ["--epochs", 2]], ids=["as it was", "with fewer epochs"])
def test_resuming_a_finished_run_says_so_and_changes_nothing(server, unbroken, tmp_path, flags):
    folder = shutil.copytree(unbroken("plain"), tmp_path / "run")
    before = files(folder)
    process = server.run(*argv_of(folder, *AGENTS["plain"], "--resume", *flags))
    assert process.code == 0 and process.err == "" and "finished" in process.out
    assert files(folder) == before


def test_a_finished_run_goes_on_when_asked_for_more_epochs(server, unbroken, tmp_path):
    folder = tmp_path / "run"
    assert server.run(*argv_of(folder, *AGENTS["plain"], "--epochs", 2)).code == 0
    assert len(rows_of(folder / "progress.csv")) == 2
    assert server.run(*argv_of(folder, *AGENTS["plain"], "--resume")).code == 0
    assert curves(folder) == curves(unbroken("plain"))


@pytest.mark.parametrize("exists", [True, False])
def test_resume_starts_anew_where_there_is_nothing_yet(server, unbroken, tmp_path, exists):
    folder = tmp_path / "run"
    if exists:
        folder.mkdir()
    assert server.run(*argv_of(folder, *AGENTS["plain"], "--resume", "--epochs", 1)).code == 0
    assert curves(folder)[1][:2] == curves(unbroken("plain"))[1][:2]
    assert curves(unbroken("plain"))[0].startswith(curves(folder)[0])


@pytest.mark.parametrize("flag, value", [("--gamma", 0.9), ("--seed", 1), ("--hidden_sizes", 8),
                                         ("--recipe", "robust"), ("--num_demos", 3)])  # fmt: skip
def test_a_resume_with_another_value_of_a_flag_is_refused_by_name(server, unbroken, flag, value):
    folder = unbroken("plain")
    before = files(folder)
    process = server.run(*argv_of(folder, *AGENTS["plain"], flag, value, "--resume"))
    assert process.code == 2 and process.err.count("\n") == 1 and not process.out
    names = ("--clip_target", "--recipe") if flag == "--recipe" else (flag,)  # or the first of what a recipe decides
    assert any(name in process.err for name in names) and files(folder) == before


def test_a_second_process_on_a_folder_is_refused_and_the_lock_of_a_killed_one_is_no_hindrance(server, tmp_path):
    folder = tmp_path / "run"
    one = server.start(*argv_of(folder, *AGENTS["plain"]))
    while one.poll() is None and steps_done(folder) < 0:
        time.sleep(0.002)
    one.send(signal.SIGSTOP)
    before = files(folder)
    two = server.run(*argv_of(folder, *AGENTS["plain"], "--resume"))
    assert two.code == 2 and two.err.count("\n") == 1 and "another process" in two.err and files(folder) == before
    assert one.poll() is None
    one.send(signal.SIGKILL)
    assert one.wait() == -signal.SIGKILL and (folder / "lock").exists()
    assert server.run(*argv_of(folder, *AGENTS["plain"], "--resume", "--epochs", 1)).code == 0


@pytest.mark.parametrize("rate", ["--pi_lr", "--q_lr"])
def test_nan_ends_the_run_with_3_its_networks_saved_and_the_last_checkpoint_kept(server, tmp_path, rate):
    folder = tmp_path / "run"
    process = server.run(*argv_of(folder, *AGENTS["so2"], rate, "1e30"))
    assert process.code == 3 and process.err.count("\n") == 1 and "NaN" in process.err
    assert set(torch.load(folder / "nan.pt", weights_only=True)) >= {"net", "target"}
    kept = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert json.loads(kept["loop"])["t"] == EPOCH and kept["learner"]["net"].isfinite().all()
    assert len(rows_of(folder / "progress.csv")) == 1


# ---- what a run is and leaves ----------------------------------------------------------------------------------------


def test_the_script_alone_in_its_own_process_gives_the_same_run(unbroken, tmp_path):
    """Also: the same command line gives the same bytes a second time."""
    argv = list(map(str, argv_of(tmp_path / "run", *AGENTS["so2"])))
    argv[0] = str(ROOT / argv[0])
    done = subprocess.run([sys.executable, *argv], capture_output=True, text=True, timeout=300)
    noise = [line for line in done.stderr.splitlines() if not line.startswith("pybullet build time")]
    assert done.returncode == 0 and not noise and curves(tmp_path / "run") == curves(unbroken("so2"))


def test_another_seed_gives_another_run(server, unbroken, tmp_path):
    assert server.run(*argv_of(tmp_path / "run", *AGENTS["plain"], "--seed", 1, "--epochs", 2)).code == 0
    assert rows_of(tmp_path / "run" / "episodes.csv")[0] != rows_of(unbroken("plain") / "episodes.csv")[0]
    assert len(rows_of(tmp_path / "run" / "episodes.csv")) >= 2


def test_plain_ddpg_is_the_same_whatever_lambda_is(server, unbroken, tmp_path):
    assert server.run(*argv_of(tmp_path / "run", *AGENTS["plain"], "--lambda_bc", 5)).code == 0
    assert curves(tmp_path / "run") == curves(unbroken("plain"))


def test_demonstrations_from_a_file_of_pid_demo_give_the_run_that_records_its_own(server, unbroken, tmp_path):
    out = tmp_path / "demos.npz"
    argv = ("--task", "p2p", "--record", 2, "--gains", "fast", "--noise", 0.2, "--seed", 0, "--out", out)
    recorded = server.run("pid_demo.py", *argv)
    assert recorded.code == 0, recorded.err
    assert server.run(*argv_of(tmp_path / "run", *AGENTS["so2"], "--demos", out)).code == 0
    assert curves(tmp_path / "run") == curves(unbroken("so2"))


@pytest.mark.parametrize("agent", AGENTS)
def test_a_run_folder_holds_the_files_of_the_design_and_no_others(unbroken, agent):
    folder = unbroken(agent)
    names = {path.name for path in folder.iterdir()}
    assert names - {"lock"} == {"config.json", "episodes.csv", "progress.csv", "checkpoint.pt", "policy.pt"}
    assert (folder / "episodes.csv").read_text().split("\n")[0] == EPISODES
    assert (folder / "progress.csv").read_text().split("\n")[0] == PROGRESS
    for name in ("checkpoint.pt", "policy.pt"):
        assert isinstance(torch.load(folder / name, weights_only=True), dict)
    policy = torch.load(folder / "policy.pt", weights_only=True)
    config = json.loads((folder / "config.json").read_text())
    width = 22 if config["task"] == "p2p" else 25
    assert policy["task"] == config["task"] and policy["symmetry"] == config["symmetry"]
    assert policy["sizes"] == [width + (agent == "ppo robust"), 16, 16, 4]  # one more says whether the cube is grasped
    assert policy["output"] == ("tanh" if agent in DDPG else "linear")
    assert not {"name", "time", "seed"} & set(policy)


@pytest.mark.parametrize("agent", AGENTS)
def test_the_curves_of_a_run_fit_together(unbroken, agent):
    folder = unbroken(agent)
    episodes, progress = rows_of(folder / "episodes.csv"), rows_of(folder / "progress.csv")
    assert [int(row["episode"]) for row in episodes] == list(range(1, len(episodes) + 1)) and len(episodes) >= 8
    assert np.cumsum([int(row["length"]) for row in episodes]).tolist() == [int(row["env_steps"]) for row in episodes]
    crossing = [row for row in episodes if (int(row["env_steps"]) - 1) // EPOCH >
                (int(row["env_steps"]) - int(row["length"])) // EPOCH]  # fmt: skip
    assert crossing  # episodes go on over the ends of epochs
    assert {row["success"] for row in episodes} <= {"0", "1"}
    assert {row["collision"] for row in episodes} <= {"", "self", "cube"}
    assert [(row["epoch"], row["env_steps"]) for row in progress] == [(f"{n}", f"{EPOCH * n}") for n in range(1, 7)]
    seconds = [float(row["seconds"]) for row in progress]
    assert seconds == sorted(seconds) and seconds[0] > 0
    own = {"L_O", "L_C", "L_A", "Q_mean", "Q_max", "pretanh_own"}
    of_demos = {"L_BC", "mask_fraction", "pretanh_demo", "bc_relative_error"}
    plain = agent.endswith("plain")
    measured = own | (of_demos if not plain else set())
    for row in progress:
        filled = {column for column, value in row.items() if value != ""}
        assert all(np.isfinite(float(row[column])) for column in filled)
        assert filled & (own | of_demos) == (measured if int(row["env_steps"]) >= 70 or agent not in DDPG else set())
        assert not filled & {"eval_success", "eval_return"}
    assert {float(row["demo_env_steps"]) > 0 for row in progress} == {not plain}


def test_config_holds_every_flag_the_command_and_the_versions(unbroken):
    folder = unbroken("so2")
    config = json.loads((folder / "config.json").read_text())
    assert {field.name for field in fields(ddpg.Flags)} <= set(config) and config["algo"] == "ddpg"
    given = dict(task="p2p", recipe="robust", num_demos=2, lambda_bc=1.8, symmetry="so2", gains="fast", seed=0,
                 epochs=6, steps_per_epoch=40, max_ep_len=28, update_every=10, gamma=0.99, hidden_sizes=[16, 16],
                 demos=None, critic_layernorm=True, name="run", data_dir=str(folder.parent), resume=False)  # fmt: skip
    assert {name: config[name] for name in given} == given
    assert Path(config["command"][0]).name == "ddpg_demoease.py" and "--update_after" in config["command"]
    assert {"python", "torch", "numpy", "gymnasium", "pybullet", "git_commit"} <= set(config["versions"])


@pytest.mark.parametrize("recipe", ["paper", "robust"])
@pytest.mark.parametrize("task", ["p2p", "p2po", "pnp"])
@pytest.mark.parametrize("algo", ["ddpg", "ppo"])
def test_every_task_trains_with_every_recipe_and_its_agent_can_be_tested(server, tmp_path, algo, task, recipe):
    argv = f"""{algo}_demoease.py --task {task} --recipe {recipe} --hidden_sizes 16 16 --epochs 2 --steps_per_epoch 200
               --max_ep_len 25 --num_demos 1 --eval_every 2 --eval_trials 1 --data_dir {tmp_path}""".split()
    argv += dict(ddpg="--start_steps 20 --update_after 30 --update_every 50", ppo="--train_iters 2")[algo].split()
    argv += ["--clone_iters", "5"] if (algo, recipe) == ("ppo", "robust") else []
    done = server.run(*argv)
    assert done.code == 0, done.err
    assert done.out.count("\n") >= 4 and "mask_fraction" in done.out  # not quiet: a table, one line an epoch
    (folder,) = tmp_path.iterdir()
    number, lam = {"p2p": (1, "1.8"), "p2po": (1, "2"), "pnp": (1, "15")}[task]
    assert folder.name.startswith(f"{task}-{algo}-{recipe}-N{number}-lambda{lam}-") and folder.name.endswith("seed0")
    rows = rows_of(folder / "progress.csv")
    assert [row["eval_success"] == "" for row in rows] == [True, False] and rows[1]["eval_return"] != ""
    assert rows[0]["L_C"] != "" and rows[0]["L_BC"] != ""
    tested = server.run("evaluate.py", folder, "--trials", 1)
    assert tested.code == 0 and len(rows_of(folder / "evaluation.csv")) == 1
    assert rows_of(folder / "episodes.csv")[0]["env_steps"] == rows_of(folder / "episodes.csv")[0]["length"]


def test_a_policy_that_is_a_pickled_object_is_one_line_of_the_test_study_too(server, tmp_path):
    (tmp_path / "policy.pt").write_bytes(pickle.dumps(Path(".")))  # torch warns of what it sees before it refuses it
    done = server.run("evaluate.py", tmp_path)
    assert done.code == 2 and done.err.count("\n") == 1 and str(tmp_path / "policy.pt") in done.err and not done.out


# ---- bad command lines -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def material(tmp_path_factory):
    """A folder of demonstration files, good and bad."""
    folder = tmp_path_factory.mktemp("material")
    demos, steps = pid_demo.record("p2p", 2, "fast", seed=0)
    meta = dict(task="p2p", stage="demo", env_steps=steps, gains="fast", seed=0, partitions=4, symmetry="none")

    def save(name, arrays=None, **changed):
        np.savez_compressed(folder / name, **(arrays or demos), meta=np.array(json.dumps(meta | changed)))

    save("two.npz")
    save("p2po.npz", task="p2po")
    for name in ("obs", "act", "rew", "obs2"):
        bad = demos[name].copy()
        bad[len(bad) // 2] = np.nan
        save(f"nan_{name}.npz", demos | {name: bad})
    save("short.npz", demos | {"act": demos["act"][:-1]})
    save("wide.npz", demos | {"act": np.zeros((steps, 5), np.float32)})
    save("narrow.npz", demos | {"obs": demos["obs"][:, :20], "obs2": demos["obs2"][:, :20]})
    save("objects.npz", demos | {"act": np.array([None] * steps)})
    save("none.npz", {name: column[:0] for name, column in demos.items()})
    np.savez_compressed(folder / "no_meta.npz", **demos)
    np.savez_compressed(folder / "empty_meta.npz", **demos, meta=np.array("{}"))
    np.savez_compressed(folder / "no_act.npz", **{k: v for k, v in demos.items() if k != "act"}, meta=np.array("{}"))
    (folder / "truncated.npz").write_bytes((folder / "two.npz").read_bytes()[:2000])
    (folder / "empty.npz").write_bytes(b"")
    (folder / "text.npz").write_text("obs,act\n1,2\n")
    np.save(folder / "array.npy", demos["obs"])
    return folder


NUMBERS = """--seed -1, --seed 4294967296, --seed x, --gamma 1.5, --gamma -0.1, --gamma nan, --polyak 1.01, --polyak -1,
    --lambda_bc -1, --lambda_bc nan, --lambda_bc inf, --num_demos -1, --num_demos 2.5, --epochs 0, --epochs -1,
    --steps_per_epoch 0, --max_ep_len 0, --update_every 0, --start_steps -1, --update_after -1, --replay_size 0,
    --batch_size 0, --demo_batch_size 0, --act_noise -0.1, --act_noise inf, --pi_lr -1, --pi_lr inf, --q_lr nan,
    --hidden_sizes 16 0, --hidden_sizes -1, --hidden_sizes, --hidden_sizes 1.5, --partitions 0, --eval_every -1,
    --eval_trials 0, --checkpoint_every 0, --task p3p, --recipe both, --symmetry so3, --gains slow,
    --device tpu, --device cuda, --nonsense 1"""
BAD = [(line.split(), line.split()[0]) for line in NUMBERS.replace("\n", "").split(",")]
BAD += [(["--name", name], "--name") for name in ("a/b", "..", ".", "")]
BAD += [(["--name", "x" * 300], "x")]
BAD += [(["--demos", f"{{material}}/{name}"], (name, says)) for name, says in {
    "missing.npz": "no such file", "p2po.npz": "its obs is", "nan_obs.npz": "nan or inf in its obs",
    "nan_act.npz": "nan or inf in its act", "nan_rew.npz": "nan or inf in its rew",
    "nan_obs2.npz": "nan or inf in its obs2", "short.npz": "its act is", "wide.npz": "its act is",
    "narrow.npz": "its obs is", "objects.npz": "Object arrays", "none.npz": "gives 0 episodes",
    "no_meta.npz": "it lacks 'meta'", "empty_meta.npz": "it lacks 'task'", "no_act.npz": "it lacks 'task'",
    "truncated.npz": "no .npz", "empty.npz": "no .npz", "text.npz": "no .npz",
    "array.npy": "no .npz"}.items()]  # fmt: skip
BAD += [
    (["--demos", "{material}"], "--demos"),
    (["--demos", "{material}/two.npz", "--num_demos", "3"], "--num_demos"),
    (["--demos", "{material}/two.npz", "--num_demos", "9", "--symmetry", "gas"], "--num_demos"),
    (["--demos", "{material}/two.npz", "--symmetry", "gas", "--partitions", "3"], "--partitions 3"),
    (["--task", "pnp", "--partitions", "30", "--num_demos", "2"], "--partitions 30"),
    (["--replay_size", "10"], "--replay_size"),
    (["--replay_size", "10000000000000"], "--replay_size"),
    (["--hidden_sizes", "10000000", "10000000"], "--hidden_sizes"),
    (["--data_dir", ""], "--data_dir"),
    (["--demos", "{material}/two.npz", "--replay_size", "10"], "--replay_size"),
    (["--data_dir", "{material}/two.npz"], "--data_dir"),
    (["--data_dir", "{material}/two.npz/deeper"], "--data_dir"),
    (["--data_dir", "{material}", "--name", "two.npz"], "two.npz"),
]


@pytest.mark.parametrize("flags, named", BAD, ids=[" ".join(flags)[:40] for flags, _ in BAD])
def test_a_bad_command_line_is_exit_code_2_and_one_line_and_leaves_nothing_behind(
    server, material, tmp_path, flags, named
):
    before = files(material)
    process = server.run(*argv_of(tmp_path / "runs" / "run", "--recipe", "robust", "--epochs", 1),
                         *(flag.format(material=material) for flag in flags))  # fmt: skip
    assert process.code == 2 and not process.out, (process.code, process.err)
    assert process.err.count("\n") == 1 and process.err.endswith("\n")
    assert all(words in process.err for words in ((named,) if isinstance(named, str) else named))
    assert not list(tmp_path.iterdir()) and files(material) == before


def test_the_help_names_every_flag(server):
    for script in (ddpg, ppo):
        process = server.run(Path(script.__file__).name, "--help")
        assert process.code == 0 and all(f"--{field.name}" in process.out for field in fields(script.Flags))
