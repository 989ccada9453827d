"""The paper's grid: which runs there are, and that a sweep killed anywhere and started again loses nothing."""

import csv
import fcntl
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

import ddpg_demoease
import logx
import ppo_demoease
import sweep

ROOT = Path(sweep.__file__).parent
TINY = ["--hidden_sizes", "16", "16", "--max_ep_len", "28", "--update_every", "10", "--start_steps", "20"]
TINY += ["--update_after", "40", "--replay_size", "3000", "--batch_size", "32", "--eval_every", "0"]
TINY += ["--checkpoint_every", "1", "--gains", "fast"]
LONG = ["--task", "p2p", "--columns", "baseline", "--epochs", "20", "--steps_per_epoch", "50"]
# The sweep as a process of its own, which knows its rate already.
SWEEP = f"import sys; sys.path[0] = {str(ROOT)!r}; import sweep; sweep.measured_rate = lambda run: 100.0; "
SWEEP += "sys.exit(sweep.main(sys.argv[1:]))"


def begin(*flags, data_dir, extra=TINY):
    """A sweep in a process group of its own."""
    words = [sys.executable, "-c", SWEEP, *map(str, flags), "--data_dir", str(data_dir), "--", *extra]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def run(*flags, data_dir, extra=TINY):
    """(exit code, standard output, standard error) of a sweep."""
    process = begin(*flags, data_dir=data_dir, extra=extra)
    out, err = process.communicate(timeout=200)
    return process.returncode, out, err


def runs_of(*flags, data_dir, extra=TINY):
    return sweep.grid(sweep.parse([*map(str, flags), "--data_dir", str(data_dir), "--", *extra]))


def wait_for(what, seconds=100):
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until
        time.sleep(0.02)


def curves(folder):
    """What a run has learned and lived, without its wall-clock times."""
    with open(folder / "progress.csv", newline="") as file:
        progress = [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]
    policy = logx.load_torch(folder / "policy.pt")
    return (folder / "episodes.csv").read_text(), progress, {k: w.tolist() for k, w in policy["weights"].items()}


# ---- the grid --------------------------------------------------------------------------------------------------------


def test_grid_is_the_papers_20_configurations_and_p2ps_two_plain_ddpg_columns_share_no_seed():
    runs = sweep.grid(sweep.parse([]))
    assert len(runs) == 100 == len({run.folder for run in runs})  # 21 printed columns, one of them printed twice
    assert Counter(run.task for run in runs) == {"p2p": 35, "p2po": 35, "pnp": 30}
    with open(ROOT / "data/paper/training_metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    printed = {(row["task"], row["algo"], int(row["num_demos"]), float(row["lambda_bc"]))
               for row in rows}  # fmt: skip
    value = {run: dict(zip(run.flags[::2], run.flags[1::2], strict=True)) for run in runs}
    assert {(run.task, run.algo, run.N, float(value[run]["--lambda_bc"])) for run in runs} == printed
    plain = [value[run] for run in runs if run.task == "p2p" and not run.N]
    assert sorted(int(v["--seed"]) for v in plain if v["--lambda_bc"] == "1") == list(range(100, 105))
    assert sorted(int(v["--seed"]) for v in plain if v["--lambda_bc"] == "0") == list(range(5))


@pytest.mark.parametrize("recipe", ["paper", "robust"])
@pytest.mark.parametrize("more", [[], ["--symmetry", "none", "--epochs", "7"], ["--steps_per_epoch", "100"]])
def test_names_and_lengths_are_those_that_the_scripts_give_by_themselves(recipe, more):
    for run in sweep.grid(sweep.parse(["--recipe", recipe, "--seeds", "1", *more])):
        script = {"ddpg": ddpg_demoease, "ppo": ppo_demoease}[run.algo]
        named = run.flags.index("--name")
        flags, _ = script.complete(logx.parse_flags(script.Flags, "", run.flags[:named] + run.flags[named + 2 :]))
        assert flags.name == run.folder.name
        assert flags.epochs * flags.steps_per_epoch == run.total


def test_columns_are_named_as_the_tables_vary_them_and_chosen_by_name():
    assert list(sweep.columns("pnp")) == ["lambda=5", "lambda=10", "lambda=15", "demos=150", "demos=250", "baseline"]
    runs = sweep.grid(sweep.parse("--task p2po --columns demos=400 baseline --seeds 2 --first_seed 3".split()))
    assert [run.folder.name for run in runs] == [
        "p2po-ddpg-paper-N400-lambda1-gas-seed3", "p2po-ddpg-paper-N400-lambda1-gas-seed4",
        "p2po-ddpg-paper-N0-lambda0-gas-seed3", "p2po-ddpg-paper-N0-lambda0-gas-seed4"]  # fmt: skip


@pytest.mark.parametrize("flags, says", [
    (["--task", "p3p"], "p3p"), (["--columns", "lambda=7"], "lambda=7"), (["--seeds", "0"], "--seeds 0"),
    (["--epochs", "0"], "--epochs 0"), (["--steps_per_epoch", "-1"], "--steps_per_epoch -1"),
    (["--jobs", "0"], "--jobs 0"), (["--first_seed", "-1"], "--first_seed -1"), (["--recipe", "best"], "best"),
    (["--time", "0"], "--time 0"), (["--time", "2"], "--time 2"), (["--cluster", "pbs"], "pbs"),
    (["--", "--seed", "3"], "--seed"), (["--", "--name=x"], "--name"),
    (["--task", "pnp", "--columns", "lambda=1.8"], "lambda=1.8"), (["--data_dir", __file__], "--data_dir"),
    (["--data_dir", ""], "--data_dir"), (["--status", "--", "--gamma", "0.9", "--quick"], "--quick"),
])  # fmt: skip
def test_bad_input_is_one_line_that_names_it_and_exit_code_2(flags, says, capsys):
    with pytest.raises(SystemExit) as stopped:
        sweep.parse(flags)
    assert stopped.value.code == 2
    error = capsys.readouterr().err.splitlines()
    assert "error:" in error[-1] and says in error[-1]


def test_flags_of_the_scripts_may_stand_alone():
    assert sweep.parse(["--", "--gamma", "0.9"]).extra == ["--gamma", "0.9"]


def test_flag_that_the_script_refuses_is_said_before_anything_is_begun(tmp_path):
    words = ["--task", "p2p", "--seeds", "1", "--data_dir", str(tmp_path / "runs"), "--", "--polyak", "2"]
    done = subprocess.run([sys.executable, str(ROOT / "sweep.py"), *words], capture_output=True, text=True)
    assert done.returncode == 2
    assert "--polyak 2.0: must be" in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()


# ---- a sweep ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Two runs of LONG that nothing stopped."""
    folder = tmp_path_factory.mktemp("unbroken")
    runs = runs_of(*LONG, "--seeds", 2, data_dir=folder)
    for begun in [sweep.start(run) for run in runs]:
        assert begun.wait() == 0
    return [curves(run.folder) for run in runs]


def test_dry_run_prints_commands_and_core_hours_and_writes_nothing(tmp_path):
    words = [*LONG, "--seeds", "2", "--dry_run", "--data_dir", str(tmp_path / "runs"), "--", *TINY]
    done = subprocess.run([sys.executable, str(ROOT / "sweep.py"), *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *commands, total = done.stdout.splitlines()
    assert [line.split()[0] for line in commands] == ["waiting"] * 2
    assert all("python ddpg_demoease.py --task p2p --recipe paper --num_demos 0" in line for line in commands)
    assert total.startswith("2 runs, 2 to do: ") and "core-hours" in total
    assert not (tmp_path / "runs").exists()


def test_sweep_whose_process_group_is_killed_and_started_again_ends_where_an_unbroken_one_ends(tmp_path, unbroken):
    flags = [*LONG, "--seeds", 2, "--jobs", 2]
    runs = runs_of(*flags, data_dir=tmp_path)
    first = begin(*flags, data_dir=tmp_path)
    wait_for(lambda: all(run.steps() >= 200 for run in runs))
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    wait_for(lambda: all(run.state()[0] == "stopped" for run in runs))
    assert all(run.steps() < run.total for run in runs)
    code, _, errors = run(*flags, data_dir=tmp_path)
    assert code == 0, errors
    assert [curves(run.folder) for run in runs] == unbroken
    code, out, _ = run(*flags, data_dir=tmp_path)
    assert code == 0 and "2 runs, 0 to do" in out
    status = run(*flags, "--status", data_dir=tmp_path)[1]
    assert "0 waiting, 0 queued, 0 running, 0 stopped, 0 failed, 2 done" in status


def test_sweep_that_is_interrupted_saves_its_runs_exits_130_and_goes_on(tmp_path, unbroken):
    flags = [*LONG, "--seeds", 2, "--jobs", 1]
    runs = runs_of(*flags, data_dir=tmp_path)
    first = begin(*flags, data_dir=tmp_path)
    wait_for(lambda: runs[0].steps() >= 200)
    status = run(*flags, "--status", data_dir=tmp_path)[1]
    assert [line.split()[0] for line in status.splitlines()[:2]] == ["running", "waiting"]
    first.send_signal(signal.SIGINT)
    assert first.wait() == 130
    assert [run.state() for run in runs] == [("stopped", ""), ("waiting", "")]
    assert (runs[0].folder / "checkpoint.pt").exists() and not runs[1].folder.exists()
    assert run(*flags, data_dir=tmp_path)[0] == 0
    assert [curves(run.folder) for run in runs] == unbroken


def test_run_that_fails_is_reported_with_its_last_line_and_does_not_stop_the_others(tmp_path, unbroken):
    runs = runs_of(*LONG, "--seeds", 2, data_dir=tmp_path)
    runs[0].folder.mkdir()
    (runs[0].folder / "checkpoint.pt").write_bytes(b"half a file")
    assert sweep.run_here(runs, 1) is False
    state, error = runs[0].state()
    assert state == "failed"
    assert error.startswith("exit code 2: ") and "checkpoint.pt" in error
    assert runs[1].state() == ("done", "")
    assert curves(runs[1].folder) == unbroken[1]
    status = run(*LONG, "--seeds", 2, "--status", data_dir=tmp_path)[1]
    assert "checkpoint.pt" in status.splitlines()[0] and "1 failed, 1 done" in status


def test_run_that_another_process_holds_is_left_alone(tmp_path):
    flags = [*LONG, "--seeds", 1]
    (only,) = runs_of(*flags, data_dir=tmp_path)
    only.folder.mkdir()
    with open(only.folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        code, out, _ = run(*flags, data_dir=tmp_path)
    assert code == 0
    assert out.startswith("running") and "1 runs, 0 to do" in out
    assert [path.name for path in only.folder.iterdir()] == ["lock"]


def test_longer_sweep_goes_on_where_a_shorter_one_was_done(tmp_path, unbroken):
    shorter = ["--task", "p2p", "--columns", "baseline", "--seeds", 1, "--steps_per_epoch", 50, "--epochs"]
    (short,), (whole,) = (runs_of(*shorter, epochs, data_dir=tmp_path) for epochs in (3, 20))
    sweep.run_here([short], 1)
    assert short.state()[0] == "done" and whole.state()[0] == "stopped"
    sweep.run_here([whole], 1)
    assert curves(whole.folder) == unbroken[0]


def test_run_that_was_made_by_hand_is_done_once_its_last_checkpoint_is_saved(tmp_path):
    short = [*LONG[:4], "--epochs", 2, "--steps_per_epoch", 50, "--seeds", 1]
    (only,) = runs_of(*short, data_dir=tmp_path)
    subprocess.run(only.command, check=True)
    assert not (only.folder / "log.txt").exists() and only.state() == ("done", "")
    later = (only.folder / "checkpoint.pt").stat().st_mtime + 1
    os.utime(only.folder / "progress.csv", (later, later))  # killed before the checkpoint was saved
    assert only.state() == ("stopped", "")


def test_cluster_without_submitit_or_without_slurm_is_one_line_and_exit_code_2(tmp_path, monkeypatch, capsys):
    words = [*LONG, "--seeds", "1", "--cluster", "slurm", "--data_dir", str(tmp_path)]
    monkeypatch.setattr(sweep, "measured_rate", lambda run: 100.0)
    monkeypatch.setenv("PATH", str(tmp_path))  # no sbatch, no srun
    if importlib.util.find_spec("submitit"):
        assert sweep.main(words) == 2
        assert len(error := capsys.readouterr().err.splitlines()) == 1 and "error: --cluster slurm: " in error[0]
    monkeypatch.setitem(sys.modules, "submitit", None)
    assert sweep.main(words) == 2
    assert capsys.readouterr().err.endswith("submitit is not installed (pip install -r requirements-slurm.txt)\n")
