"""The sweep: which runs there are, and that one killed anywhere and started again loses nothing."""

import contextlib
import csv
import fcntl
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections import Counter
from pathlib import Path

import pytest

import logx
import sweep

ROOT = Path(sweep.__file__).parent
TINY = ["hidden_sizes=16x16", "max_ep_len=28", "update_every=10", "start_steps=20", "update_after=40", "gains=fast"]
TINY += ["replay_size=3000", "batch_size=32", "eval_every=0", "checkpoint_every=1", "steps_per_epoch=50"]
SHORT = ["--task", "p2p", "--columns", "baseline", "--vary", *TINY, "--epochs", "3"]
ENDLESS = [*SHORT[:-1], "100000000"]  # no machine is fast enough to end it


@pytest.fixture
def begin():
    """Begins a sweep as a process, in a group of its own; no run outlives the test."""
    begun = []

    def sweep_with(*flags):
        words = [sys.executable, str(ROOT / "sweep.py"), *flags]
        begun.append(subprocess.Popen(words, stdout=subprocess.DEVNULL, start_new_session=True))
        return begun[-1]

    yield sweep_with
    for process in begun:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture(autouse=True, scope="module")
def handlers():
    """A sweep in this process takes SIGINT and SIGTERM: they are given back."""
    before = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    for number, handler in before:
        signal.signal(number, handler)


def jobs_of(*flags):
    return sweep.grid(sweep.parse([*map(str, flags)]))


def value_of(job):
    """{flag: value} of a job whose flags take one value each."""
    return dict(zip(job.words[1::2], job.words[2::2], strict=True))


def wait_for(what, seconds=100):
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until
        time.sleep(0.02)


def finish(job, epochs, data_dir=None):
    """What the run of an endless job has learned and lived when it goes on, or anew in data_dir, to some epochs."""
    folder = (data_dir or job.folder.parent) / job.folder.name
    where = ["--name", folder.name, "--data_dir", str(folder.parent), "--epochs", str(epochs)]
    subprocess.run([*job.command, *where], check=True)
    with open(folder / "progress.csv", newline="") as file:
        progress = [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]
    weights = logx.load_torch(folder / "policy.pt")["weights"]
    return (folder / "episodes.csv").read_text(), progress, {name: w.tolist() for name, w in weights.items()}


def ends_as_an_unbroken_run(job, data_dir):
    epochs = len(job.rows()) + 2
    return finish(job, epochs) == finish(job, epochs, data_dir)


# ---- the grid --------------------------------------------------------------------------------------------------------


def test_grid_is_the_papers_20_configurations_and_p2ps_two_plain_ddpg_columns_share_no_seed():
    jobs = jobs_of()
    assert len(jobs) == 100 == len({job.folder for job in jobs})  # 21 printed columns, one of them printed twice
    values = [value_of(job) for job in jobs]
    assert Counter(v["--task"] for v in values) == {"p2p": 35, "p2po": 35, "pnp": 30}
    with open(ROOT / "data/paper/training_metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    printed = {(row["task"], row["algo"], int(row["num_demos"]), float(row["lambda_bc"])) for row in rows}
    assert printed == {(v["--task"], job.words[0][: -len("_demoease.py")], int(v["--num_demos"]),
                        float(v["--lambda_bc"])) for job, v in zip(jobs, values, strict=True)}  # fmt: skip
    plain = [v for v in values if v["--task"] == "p2p" and v["--num_demos"] == "0"]
    assert sorted(int(v["--seed"]) for v in plain if v["--lambda_bc"] == "1") == list(range(100, 105))
    assert sorted(int(v["--seed"]) for v in plain if v["--lambda_bc"] == "0") == list(range(5))


@pytest.mark.parametrize("flags, names, total", [
    ("--task p2p --columns lambda=1.8", ["p2p-ddpg-paper-N100-lambda1.8-gas-seed0"], 500_000),
    ("--task p2p --columns lambda=1.8 --recipe robust", ["p2p-ddpg-robust-N100-lambda1.8-mirror-seed0"], 25_000),
    ("--task p2p --columns lambda=1.8 --recipe robust --epochs 7",
     ["p2p-ddpg-robust-N100-lambda1.8-mirror-epochs=7-seed0"], 7_000),
    ("--task p2po --columns baseline --recipe robust", ["p2po-ddpg-robust-N0-lambda0-mirror-seed0"], 100_000),
    ("--task pnp --columns lambda=15 --recipe robust", ["pnp-ppo-robust-N400-lambda15-mirror-seed0"], 200_000),
    ("--task p2p --columns lambda=1.8 --vary symmetry=none,gas num_demos=4,8 --recipe robust",
     [f"p2p-ddpg-robust-N{N}-lambda1.8-{symmetry}-seed0" for symmetry in ("none", "gas") for N in (4, 8)], 25_000),
    ("--task p2p --columns lambda=1.8 --vary recipe=paper,robust gamma=0.9 steps_per_epoch=10 epochs=2",
     ["p2p-ddpg-paper-N100-lambda1.8-gas-steps_per_epoch=10-gamma=0.9-epochs=2-seed0",
      "p2p-ddpg-robust-N100-lambda1.8-mirror-steps_per_epoch=10-gamma=0.9-epochs=2-seed0"], 20),
])  # fmt: skip
def test_folders_and_lengths_are_those_that_the_script_gives_by_itself(flags, names, total):
    jobs = jobs_of(*flags.split(), "--seeds", 1)
    assert [job.folder.name for job in jobs] == names and {job.total for job in jobs} == {total}


def test_columns_are_named_as_the_tables_vary_them_and_chosen_by_name():
    assert list(sweep.columns("pnp")) == ["lambda=5", "lambda=10", "lambda=15", "demos=150", "demos=250", "baseline"]
    jobs = jobs_of(*"--task p2po --columns demos=400 baseline --seeds 2 --first_seed 3".split())
    assert [job.folder.name for job in jobs] == [
        "p2po-ddpg-paper-N400-lambda1-gas-seed3", "p2po-ddpg-paper-N400-lambda1-gas-seed4",
        "p2po-ddpg-paper-N0-lambda0-gas-seed3", "p2po-ddpg-paper-N0-lambda0-gas-seed4"]  # fmt: skip


def test_columns_that_vary_makes_the_same_are_one_run():
    jobs = jobs_of(*"--task p2p --columns demos=80 demos=160 --vary num_demos=4 --seeds 1".split())
    assert [job.folder.name for job in jobs] == ["p2p-ddpg-paper-N4-lambda1-gas-seed0"]


def test_varied_values_are_written_as_in_the_names_of_folders():
    vary = ["hidden_sizes=64x32,8", "grasp_input=True,False", "demos_in_B_o=False,True"]
    jobs = jobs_of("--task", "pnp", "--columns", "baseline", "--vary", *vary, "--seeds", 1)
    assert len(jobs) == 8
    assert " ".join(jobs[0].words).endswith(
        "--hidden_sizes 64 32 --grasp_input --no-demos_in_B_o --data_dir data/runs --seed 0")  # fmt: skip
    assert " ".join(jobs[7].words).endswith(
        "--hidden_sizes 8 --no-grasp_input --demos_in_B_o --data_dir data/runs --seed 0")  # fmt: skip
    assert "hidden_sizes=64x32-demos_in_B_o=False-grasp_input=True" in jobs[0].folder.name


@pytest.mark.parametrize("flags, says", [
    (["--columns", "lambda=7"], "--columns lambda=7: p2p p2po pnp has lambda=0.1"),
    (["--task", "pnp", "--columns", "lambda=1.8"], "--columns lambda=1.8: pnp has lambda=5"),
    (["--seeds", "0"], "--seeds 0: must be at least 1"),
    (["--partition", "cpu"], "--partition: goes with --cluster"),
    (["--cluster", "slurm", "--nice", "9"], "--nice: goes without --cluster"),
    (["--epochs", "2", "--vary", "epochs=3"], "--epochs 2: does not go with --vary epochs"),
    (["--vary", "eval_every=0,5"], "--vary eval_every: 0 and 5 make the one folder data/runs/p2p-ddpg-paper-N100"),
    (["--time", "2"], "--time 2: must be --signal_delay, 90 s, and a minute more"),
    (["--data_dir", __file__], f"--data_dir {__file__}: is a file"),
    (["--vary", "gamma"], "--vary gamma: must be FLAG=VALUE"),
    (["--vary", "seed=1,2"], "--vary seed=1,2: must be FLAG=VALUE,... once, and not of task, seed"),
    (["--vary", "help=True"], "--vary help=True: must be FLAG=VALUE"),
    (["--vary", "=1"], "--vary =1: must be FLAG=VALUE"),
    (["--vary", "gamma=0.9", "gamma=1"], "--vary gamma=1: must be FLAG=VALUE,... once"),
    (["--vary", "gamma=0.9,2"], "ddpg_demoease.py: --gamma 2.0: must be at least 0 and at most 1"),
    (["--vary", "clip_ratio=0.1"], "ddpg_demoease.py: --clip_ratio: no such flag"),
    (["--task", "pnp", "--vary", "n_step=5"], "ppo_demoease.py: --n_step: no such flag"),
    (["--vary", "num_demos=4,many"], "ddpg_demoease.py: argument --num_demos: invalid int value: 'many'"),
])  # fmt: skip
def test_bad_input_names_the_flag_and_what_is_allowed(flags, says):
    with pytest.raises(logx.BadInput) as refused:
        jobs_of(*flags)
    assert str(refused.value).startswith(says)


def test_bad_value_is_one_line_and_exit_code_2_before_anything_is_begun(tmp_path):
    words = ["--task", "p2p", "--vary", "polyak=0.9,2", "--data_dir", str(tmp_path / "runs")]
    done = subprocess.run([sys.executable, str(ROOT / "sweep.py"), *words], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "") and not (tmp_path / "runs").exists()
    assert done.stderr == "sweep.py: error: ddpg_demoease.py: --polyak 2.0: must be at least 0 and at most 1\n"


# ---- a sweep ---------------------------------------------------------------------------------------------------------


def test_dry_run_prints_commands_and_core_hours_and_writes_nothing(tmp_path, capsys):
    flags = [*SHORT, "--recipe", "robust", "--columns", "lambda=1.8", "--data_dir", str(tmp_path / "runs")]
    assert sweep.main([*flags, "--seeds", "2", "--dry_run"]) == 0
    *commands, total = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in commands] == ["waiting"] * 2
    assert all("min  python ddpg_demoease.py --task p2p --recipe robust" in line for line in commands)
    assert total.startswith("2 runs, 2 to do: ") and "core-hours" in total
    assert not (tmp_path / "runs").exists()


def test_sweep_killed_and_started_again_and_interrupted_ends_where_an_unbroken_one_ends(tmp_path, capsys, begin):
    flags = [*ENDLESS, "--seeds", "2", "--data_dir", str(tmp_path / "runs")]
    jobs = jobs_of(*flags)
    first = begin(*flags)
    wait_for(lambda: jobs[0].steps() >= 200)
    sweep.main([*flags, "--status"])
    line, total = capsys.readouterr().out.splitlines()
    assert line.startswith("running ") and " h to come " in line and line.endswith(str(jobs[0].folder))
    assert total == "1 running; of the 2 runs asked for, 1 are not begun"
    os.killpg(first.pid, signal.SIGKILL)
    wait_for(lambda: [job.state() for job in jobs] == [("stopped", ""), ("waiting", "")])
    before = jobs[0].steps()
    second = begin(*flags)
    wait_for(lambda: jobs[0].steps() > before)
    second.send_signal(signal.SIGINT)
    assert second.wait() == 130
    assert [job.state() for job in jobs] == [("stopped", ""), ("waiting", "")] and not jobs[1].folder.exists()
    assert ends_as_an_unbroken_run(jobs[0], tmp_path / "unbroken")


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """(flags, jobs, exit code) of a sweep of two runs of which the first cannot go on."""
    folder = tmp_path_factory.mktemp("swept")
    flags = [*SHORT, "--seeds", "2", "--jobs", "2", "--data_dir", str(folder)]
    jobs = jobs_of(*flags)
    jobs[0].folder.mkdir()
    (jobs[0].folder / "checkpoint.pt").write_bytes(b"half a file")
    return flags, jobs, sweep.main(flags)


def test_a_folder_that_cannot_be_written_does_not_stop_the_other_runs(tmp_path, capsys):
    flags = [*SHORT, "--data_dir", str(tmp_path), "--seeds", "2"]
    spoilt, other = jobs_of(*flags)
    spoilt.folder.write_text("a file")
    assert sweep.main(flags) == 1 and other.state() == ("done", "")
    assert f"failed   {spoilt.folder} cannot be written" in "".join(capsys.readouterr())


def test_run_that_fails_is_reported_with_its_last_line_and_does_not_stop_the_others(swept, capsys):
    flags, jobs, code = swept
    state, error = jobs[0].state()
    assert (code, state) == (1, "failed") and error.startswith("exit code 2: ") and "checkpoint.pt" in error
    assert jobs[1].state() == ("done", "")
    sweep.main([*flags, "--status"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith(error) and lines[1].startswith("done     100.0 %")
    assert lines[2] == "1 done, 1 failed; of the 2 runs asked for, 0 are not begun"


def test_what_is_done_is_not_run_again(swept, capsys):
    flags, jobs, *_ = swept
    assert sweep.main([*flags, "--seeds", "1", "--first_seed", "1"]) == 0
    assert capsys.readouterr().out.endswith("1 runs, 0 to do\n")


def test_status_lists_whatever_lies_in_the_folder(swept, tmp_path, capsys):
    _, jobs, *_ = swept
    shutil.copytree(jobs[1].folder, tmp_path / "by-hand")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.json").write_text("{")
    (tmp_path / "slurm").mkdir()
    (tmp_path / "pid").mkdir()
    (tmp_path / "pid" / "config.json").write_text('{"algo": "pid"}')  # of evaluate.py --pid: no run
    sweep.main(["--status", "--data_dir", str(tmp_path)])
    out, err = capsys.readouterr()
    assert [line.split() for line in out.splitlines()] == [
        ["done", "100.0", "%", str(tmp_path / "by-hand")],
        "1 done; of the 100 runs asked for, 100 are not begun".split()]  # fmt: skip
    assert err.startswith(f"{tmp_path}/broken: no run's config.json") and err.count("\n") == 1


def test_run_that_was_made_by_hand_is_done_once_its_last_checkpoint_is_saved(swept, tmp_path):
    _, jobs, *_ = swept
    job = sweep.Job(shutil.copytree(jobs[1].folder, tmp_path / "a"), jobs[1].total)
    (job.folder / "log.txt").unlink()
    times = [os.stat(job.folder / "progress.csv").st_mtime + seconds for seconds in (0, 1)]
    for saved, logged, state in ((*times, "stopped"), (*times[::-1], "done")):  # killed before it was saved; after it
        os.utime(job.folder / "checkpoint.pt", (saved, saved))
        os.utime(job.folder / "progress.csv", (logged, logged))
        assert job.state() == (state, "")


def test_line_of_the_curve_that_is_being_written_is_left_out(tmp_path):
    (tmp_path / "progress.csv").write_text("epoch,env_steps,x\n1,50,\n2,10")
    assert sweep.Job(tmp_path, 100).steps() == 50
    (tmp_path / "progress.csv").write_text("epoch,env_")
    assert sweep.Job(tmp_path, 100).steps() == 0


@pytest.mark.parametrize("curve", ["foo\nbar\n", "epoch,env_steps\n1,abc\n"])
def test_damaged_curve_is_one_line_that_names_it(tmp_path, curve):
    flags = [*SHORT, "--seeds", "1", "--data_dir", str(tmp_path), "--dry_run"]
    (job,) = jobs_of(*flags)
    job.folder.mkdir()
    (job.folder / "progress.csv").write_text(curve)
    with pytest.raises(logx.BadInput, match="progress.csv: no number of env_steps"):
        sweep.main(flags)


def test_run_that_another_process_holds_is_running_and_its_refusal_is_no_failure(tmp_path, capsys):
    flags = [*SHORT, "--seeds", "1", "--data_dir", str(tmp_path)]
    (job,) = jobs_of(*flags)
    job.folder.mkdir()
    with open(job.folder / "lock", "w") as lock:  # as a run that outlived its sweep
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert sweep.main(flags) == 0
        assert capsys.readouterr().out.startswith("running") and not (job.folder / "log.txt").exists()
        assert sweep.run_here([job], 1) is False  # as where it took the lock a moment later
        assert sweep.HELD in job.text("log.txt") and job.state() == ("running", "")
        assert capsys.readouterr().out.split() == ["running", str(job.folder)]
    assert job.state() == ("waiting", "")


def test_cluster_without_submitit_or_without_slurm_is_bad_input(tmp_path, monkeypatch):
    flags = [*SHORT, "--seeds", "1", "--cluster", "slurm", "--data_dir", str(tmp_path)]
    monkeypatch.setenv("PATH", str(tmp_path))  # no sbatch, no srun
    if importlib.util.find_spec("submitit"):
        with pytest.raises(logx.BadInput, match="^--cluster slurm: Could not detect"):
            sweep.main(flags)
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(logx.BadInput, match="^--cluster slurm: needs submitit"):
        sweep.main(flags)


# ---- the project -----------------------------------------------------------------------------------------------------


def test_installation_in_place_knows_every_script():
    modules = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["py-modules"]
    assert {path.stem for path in ROOT.glob("*.py")} <= set(modules)
