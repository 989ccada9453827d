"""logx.py: the environment of a run, and its folder."""

import json
import math
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

import logx
from ddpg_demoease import Flags
from logx import BadInput
from test_logx import contents, saved

MEASURED = ["L_C", "L_A"]


def folder_of(path, algo="ddpg", **changes):
    """A run's folder as a script takes it: path is DATA_DIR/NAME."""
    flags = Flags(epochs=4, steps_per_epoch=50, hidden_sizes=(16, 16), name=path.name, quiet=True)
    flags = replace(flags, data_dir=str(path.parent), **changes)
    return logx.RunFolder(flags, algo, MEASURED)


def log_episode(run, t, success=False):
    episode = {"r": -t / 3, "l": t}
    run.log_episode(t, {"episode": episode, "is_success": success, "collision": "" if success else "self"})


@pytest.fixture
def stopped(tmp_path):
    """A run that was stopped after a checkpoint at step 50, with rows that the checkpoint does not know."""
    with folder_of(tmp_path / "a") as run:
        run.begin(demo_env_steps=7)
        for t in (20, 50):
            log_episode(run, t)
        run.log_epoch(50, dict)
        run.save({"t": 50, "tensor": torch.arange(3)}, {"weights": {}})
        log_episode(run, 90)
        run.log_epoch(100, dict)
    return tmp_path / "a"


def first_column(path):
    return [line.split(",")[0] for line in path.read_text().splitlines()]


# ---- the environment of a run ----------------------------------------------------------------------------------------


def test_an_environment_loaded_in_mid_episode_goes_on_bit_for_bit():
    def make():
        env = gymnasium.make("KinovaP2P-v0", max_episode_steps=15, disable_env_checker=True)
        return logx.Replayable(env, seed=3)

    def step(env, n):
        """n steps of the same actions, episodes begun as they end: what was seen."""
        seen = []
        for _ in range(n):
            s, r, terminated, truncated, info = env.step(a)
            seen.append((s.tolist(), r, info.get("episode")))
            if terminated or truncated:
                seen.append(env.reset()[0].tolist())
        return seen

    a = np.array([1, -0.5, 0.3, 0.1], dtype=np.float32)
    one, other = make(), make()
    one.reset()
    step(one, 20)  # into the second episode
    state = json.loads(json.dumps(one.state()))
    assert len(state["actions"]) == 5 == len(one.episode)
    assert np.array_equal(other.load(state), one.episode[-1][3])
    assert step(one, 40) == step(other, 40)  # the goals of the next episodes too


def test_the_last_step_tells_the_episodes_return_and_length_and_an_action_of_nan_ends_the_run():
    env = logx.Replayable(gymnasium.make("KinovaP2P-v0", max_episode_steps=3, disable_env_checker=True), seed=0)
    env.reset()
    steps = [env.step(np.zeros(4, dtype=np.float32)) for _ in range(3)]
    assert "episode" not in steps[1][4]
    assert steps[2][4]["episode"] == {"r": sum(step[1] for step in steps), "l": 3}
    with pytest.raises(logx.NotFinite):
        env.step(np.full(4, np.nan, dtype=np.float32))


# ---- a run's folder --------------------------------------------------------------------------------------------------


def test_a_new_run_has_its_flags_its_command_and_curves_with_the_columns_of_its_algorithm(tmp_path):
    with folder_of(tmp_path / "deep" / "a") as run:
        run.begin()
    config = json.loads((run.folder / "config.json").read_text())
    assert config["command"] == sys.argv and config["versions"] == logx.versions()
    assert config["algo"] == "ddpg" and config["hidden_sizes"] == [16, 16] and config["variant"] == ""
    assert (run.folder / "episodes.csv").read_text() == "episode,env_steps,return,length,success,collision\n"
    assert (run.folder / "progress.csv").read_text() == (
        "epoch,env_steps,demo_env_steps,seconds,EpRet,EpLen,Success,L_C,L_A,eval_success,eval_return\n")  # fmt: skip


def test_an_epochs_row_is_the_mean_of_its_episodes_and_updates_and_blank_where_nothing_was_measured(tmp_path):
    with folder_of(tmp_path / "a", eval_every=1) as run:
        run.begin(demo_env_steps=300)
        log_episode(run, 30, success=True)
        log_episode(run, 45)
        for L_C in (1.0, 2.0):
            run.log_updates({"L_C": L_C, "L_A": math.nan}, torch.nn.Linear(1, 1))
        run.log_epoch(50, lambda: {"eval_success": 0.5, "eval_return": -1.25})
        run.log_epoch(100, dict)
    episodes = (run.folder / "episodes.csv").read_text().splitlines()
    assert episodes[1:] == ["1,30,-10,30,1,", "2,45,-15,45,0,self"]
    first, second = (line.split(",") for line in (run.folder / "progress.csv").read_text().splitlines()[1:])
    assert first[:3] + first[4:] == ["1", "50", "300", "-12.5", "37.5", "0.5", "1.5", "", "0.5", "-1.25"]
    assert second[:3] + second[4:] == ["2", "100", "300"] + [""] * 7  # the next epoch begins with nothing


@pytest.mark.parametrize("weight", [math.nan, math.inf])
def test_a_weight_that_is_not_finite_ends_the_run_and_says_what_to_do(tmp_path, weight):
    net = torch.nn.Linear(1, 1)
    torch.nn.init.constant_(net.weight, weight)
    with folder_of(tmp_path / "a") as run, pytest.raises(logx.NotFinite, match="smaller learning rates"):
        run.begin()
        run.log_updates({"L_C": 0.0, "L_A": 0.0}, net)


def test_the_table_is_said_unless_quiet_and_standard_error_is_silent_where_it_is_no_terminal(tmp_path, capsys):
    for quiet in (True, False):
        with folder_of(tmp_path / str(quiet), quiet=quiet) as run:
            run.begin(demo_env_steps=1234)
            log_episode(run, 50, success=True)
            run.log_epoch(50, dict)
        out, err = capsys.readouterr()
        assert err == "" and bool(out) is not quiet
    title, heads, row = out.splitlines()
    assert title == f"{run.folder}: 200 steps, 1,234 of the demonstrator"
    assert dict(zip(heads.replace(" %", "%").split(), row.split(), strict=True)) == {
        "valid%": "-", "epoch": "1", "steps": "50", "EpRet": "-16.67", "train%": "100", "EpLen": "50"}  # fmt: skip


def test_a_resume_cuts_the_curves_back_to_the_checkpoint_and_goes_on_from_there(stopped):
    with open(stopped / "episodes.csv", "a") as file:
        file.write("4,3")  # a row cut off by a kill
    with folder_of(stopped, resume=True) as run:
        assert run.checkpoint["t"] == 50 and torch.equal(run.checkpoint["tensor"], torch.arange(3))
        assert not run.finished()
        run.begin()
        assert first_column(stopped / "episodes.csv") == ["episode", "1", "2"]
        assert first_column(stopped / "progress.csv") == ["epoch", "1"]
        log_episode(run, 60)
        run.log_epoch(100, dict)
    assert (stopped / "episodes.csv").read_text().splitlines()[-1] == "3,60,-20,60,0,self"
    assert (stopped / "progress.csv").read_text().splitlines()[-1].startswith("2,100,7,")  # its demonstrations too


def test_a_test_study_of_a_policy_that_learns_on_is_set_aside_and_says_of_which_steps_it_is(stopped):
    for name in ("evaluation.csv", "evaluation-horizon_600.csv", "trajectories.npz"):
        (stopped / name).write_text(name)
    for _ in range(2):
        with folder_of(stopped, resume=True) as run:
            run.begin()
    found = {path.name: path.read_text() for path in stopped.glob("*-steps_*")}
    assert found == {"evaluation-steps_50.csv": "evaluation.csv", "trajectories-steps_50.npz": "trajectories.npz",
                     "evaluation-horizon_600-steps_50.csv": "evaluation-horizon_600.csv"}  # fmt: skip
    assert not (stopped / "evaluation.csv").exists()


def test_a_resume_without_a_checkpoint_begins_a_new_run_and_says_so(tmp_path, capsys):
    with folder_of(tmp_path / "a") as run:
        run.begin()
        log_episode(run, 20)
    with folder_of(tmp_path / "a", resume=True, quiet=False) as run:
        assert run.checkpoint is None
        run.begin()
    assert first_column(tmp_path / "a" / "episodes.csv") == ["episode"]
    assert capsys.readouterr().out.startswith(f"{run.folder}: no checkpoint there, so this begins a new run\n")


def test_a_run_has_the_default_of_a_flag_that_is_newer_and_goes_on_with_no_other(stopped):
    saved = torch.load(stopped / "checkpoint.pt", weights_only=True)
    config = {name: value for name, value in json.loads(saved["config"]).items() if name != "gamma"}
    torch.save(saved | {"config": json.dumps(config)}, stopped / "checkpoint.pt")
    (stopped / "config.json").write_text(json.dumps(config | {"versions": {}}))
    assert logx.recorded(Flags, {"resume": str(stopped)}).gamma == 0.99
    with pytest.raises(BadInput, match="made with --gamma 0.99, not 0.5"):
        folder_of(stopped, resume=True, gamma=0.5)
    with folder_of(stopped, resume=True) as run:
        assert run.checkpoint["t"] == 50


def test_a_run_that_has_lost_its_checkpoint_keeps_its_curves(stopped):
    (stopped / "checkpoint.pt").unlink()
    before = {path.name: path.read_bytes() for path in stopped.iterdir()}
    with pytest.raises(BadInput, match=f"{stopped} has lost its checkpoint.pt"):
        folder_of(stopped, resume=True)
    assert {path.name: path.read_bytes() for path in stopped.iterdir()} == before


def test_a_run_that_was_killed_between_its_checkpoint_and_its_policy_gets_the_policy_back(stopped):
    before = (stopped / "policy.pt").read_bytes()
    (stopped / "policy.pt").unlink()
    with folder_of(stopped, resume=True):
        assert (stopped / "policy.pt").read_bytes() == before


def test_a_published_run_is_not_begun_again_in_its_place(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "episodes.csv.gz").touch()
    with pytest.raises(BadInput, match="is a published run"):
        folder_of(tmp_path / "a", resume=True)
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["episodes.csv.gz"]


def test_a_run_whose_output_nobody_reads_does_not_end_as_done():
    code = "import logx; logx.run_script(lambda: [print(i) for i in range(10**5)] and None)"
    shell = f"{sys.executable} -c '{code}' | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", shell], cwd=Path(logx.__file__).parent, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_run_at_its_end_is_finished_and_goes_on_with_more_epochs(stopped, capsys):
    with folder_of(stopped, resume=True, epochs=1) as run:
        assert (
            run.finished() and f"finished, 50 steps; more with --resume {stopped} --epochs" in capsys.readouterr().out
        )
    with folder_of(stopped, resume=True, epochs=9) as run:
        assert not run.finished()
        run.begin()
    assert json.loads((stopped / "config.json").read_text())["epochs"] == 9


def test_the_seconds_of_a_resumed_run_include_the_earlier_parts_and_no_clock_that_jumps(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(logx.time, "monotonic", lambda: now[0])
    with folder_of(tmp_path / "a") as run:
        run.begin()
        now[0] += 7
        run.save({"t": 1}, {})
        now[0] += 1000  # not the run's
    with folder_of(tmp_path / "a", resume=True) as run:
        run.begin()
        now[0] += 5
        assert run.seconds() == 12


def test_a_folder_with_a_run_is_not_begun_again_but_by_a_resume(stopped):
    before = contents(stopped)
    with pytest.raises(BadInput, match="--name a: .* exists; go on with --resume, or choose another --name"):
        folder_of(stopped)
    assert contents(stopped) == before


def test_a_folder_that_is_held_is_refused_from_the_first_moment_until_it_is_let_go(tmp_path):
    with folder_of(tmp_path / "a"):
        with pytest.raises(BadInput, match="--name a: another process is running"):
            folder_of(tmp_path / "a", resume=True)
        assert contents(tmp_path / "a") == {"lock": b""}
    with folder_of(tmp_path / "a", resume=True) as run:
        run.begin()


def test_a_folder_that_was_made_for_nothing_is_removed(tmp_path):
    with pytest.raises(BadInput, match="no demonstrations"), folder_of(tmp_path / "a"):
        raise BadInput("no demonstrations")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("changes, says", [
    (dict(gamma=0.9), "made with --gamma 0.99, not 0.9"), (dict(hidden_sizes=(16, 8)), "made with --hidden_sizes"),
    (dict(algo="ppo"), "a run of ddpg, not of ppo"),
])  # fmt: skip
def test_a_checkpoint_goes_on_only_as_the_run_it_was_made_by(stopped, changes, says):
    before = contents(stopped)
    with pytest.raises(BadInput, match=f"--resume: .*checkpoint.pt: {says}"):
        folder_of(stopped, resume=True, **changes)
    assert contents(stopped) == before
    with folder_of(stopped, resume=True, quiet=False):  # and is let go
        pass


def spoil(name, data):
    """Something to do to a run's folder: data in place of the file `name`, None for nothing."""

    def change(folder):
        (folder / name).unlink()
        if data is not None:
            (folder / name).write_bytes(data)

    return change


@pytest.mark.parametrize("change, says", [
    (spoil("config.json", b"{"), "config.json"), (spoil("config.json", b"[]"), "config.json"),
    (spoil("config.json", None), "config.json"), (spoil("episodes.csv", None), "episodes.csv is gone or shorter"),
    (spoil("progress.csv", b"epoch"), "progress.csv is gone or shorter"),
    (spoil("checkpoint.pt", b"half a file"), "checkpoint.pt: cut short"),
    (spoil("checkpoint.pt", saved({"format": logx.FORMAT})), "checkpoint.pt: of another version"),
    (spoil("checkpoint.pt", saved([1])), "checkpoint.pt: of another version"),
], ids="cut list gone curve-gone curve-cut checkpoint-cut checkpoint-parts checkpoint-list".split())  # fmt: skip
def test_a_folder_that_cannot_be_gone_on_with_is_refused_by_the_name_of_the_file(stopped, change, says):
    change(stopped)
    before = contents(stopped)
    with pytest.raises(BadInput, match=f"--resume: .*{says}"):
        folder_of(stopped, resume=True)
    assert contents(stopped) == before


@pytest.mark.parametrize("where", ["file/a", "file", "x" * 300])
def test_a_folder_that_cannot_be_made_is_refused(tmp_path, where):
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="--data_dir|--name"):
        folder_of(tmp_path / where)
    assert contents(tmp_path) == {"file": b""}


@pytest.mark.extras
def test_tensorboard_has_every_column_in_a_group_and_the_flags(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with folder_of(tmp_path / "a", tensorboard=True) as run:
        run.begin(0)
        run.log_epoch(10, lambda: {"eval_success": 0.5, "eval_return": 1.0})
    board = EventAccumulator(str(run.folder))
    board.Reload()
    assert {"test/eval_success", "test/eval_return", "time/seconds"} <= set(board.Tags()["scalars"])
    assert [event.value for event in board.Scalars("test/eval_success")] == [0.5]
    assert b"lambda_bc" in board.SummaryMetadata("_hparams_/session_start_info").plugin_data.content


def test_tensorboard_that_is_not_installed_is_refused_and_leaves_no_folder(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(BadInput, match="--tensorboard: needs the tensorboard package"):
        folder_of(tmp_path / "a", tensorboard=True)
    assert not list(tmp_path.iterdir())


def test_a_resume_with_other_versions_is_on_record_and_the_first_ones_stay(tmp_path, monkeypatch):
    def record(commit, epochs=4):
        monkeypatch.setattr(logx, "versions", lambda: {"git_commit": commit})
        with folder_of(tmp_path / "a", resume=True, epochs=epochs) as run:
            run.begin()
            run.save({"t": 1}, {})
        return json.loads((run.folder / "config.json").read_text())

    one, two = {"git_commit": "one"}, {"git_commit": "two"}
    assert record("one")["versions"] == one and "resumed_with" not in record("one")
    assert record("two")["resumed_with"] == [two] == record("two")["resumed_with"]
    longer = record("two", epochs=5)
    assert (longer["epochs"], longer["versions"], longer["resumed_with"]) == (5, one, [two])
    assert record("one", epochs=5)["resumed_with"] == [two, one]


@pytest.mark.parametrize("number", logx.STOP_SIGNALS)
def test_a_signal_asks_a_begun_run_to_stop_and_ends_one_that_has_nothing_to_save(tmp_path, number):
    before = signal.getsignal(number)
    with folder_of(tmp_path / "a") as run:
        run.begin()
        os.kill(os.getpid(), number)
        assert run.stop_signals == [number]
    assert signal.getsignal(number) == before
    with pytest.raises(KeyboardInterrupt), folder_of(tmp_path / "b"):
        os.kill(os.getpid(), number)
    assert not (tmp_path / "b").exists()


def test_a_run_in_a_thread_leaves_signals_alone(tmp_path):
    def in_thread():
        with folder_of(tmp_path / "a") as run:
            run.begin()
            seen.append(signal.getsignal(signal.SIGTERM))

    seen = [signal.getsignal(signal.SIGTERM)]
    thread = threading.Thread(target=in_thread)
    thread.start()
    thread.join()
    assert len(seen) == 2 and seen[0] == seen[1]


def test_resume_of_a_folder_takes_the_flags_of_the_run_there_and_what_is_asked_now(stopped, monkeypatch):
    for folder, inside in ((stopped, stopped.parent), (".", stopped), (stopped.name, stopped.parent)):
        monkeypatch.chdir(inside)
        flags = logx.parse_flags(Flags, "", ["--resume", str(folder), "--epochs", "9", "--gamma", "0.99"])
        assert (flags.epochs, flags.gamma, flags.hidden_sizes, flags.resume) == (9, 0.99, (16, 16), True)
        assert (Path(flags.data_dir) / flags.name).resolve() == stopped.resolve()
    for name in ("name", "data_dir"):
        with pytest.raises(BadInput, match=f"--{name} b: does not go with --resume"):
            logx.parse_flags(Flags, "", ["--resume", str(stopped), f"--{name}", "b"])
    assert logx.parse_flags(Flags, "", ["--resume"]) == Flags(resume=True)


@pytest.mark.parametrize("name, data, says", [
    ("config.json", None, "No such file"), ("config.json", b"{", "Expecting"),
    ("config.json", b"[]", "no attribute"), ("config.json", b"{}", "config.json, of None, lacks"),
])  # fmt: skip
def test_resume_of_a_folder_without_a_run_to_go_on_with_is_refused(stopped, name, data, says):
    spoil(name, data)(stopped)
    with pytest.raises(BadInput, match=f"--resume {stopped}: must be a run's folder .*{says}"):
        logx.recorded(Flags, {"resume": str(stopped)})


def test_a_run_killed_before_its_first_checkpoint_is_begun_anew_from_its_folder(stopped):
    spoil("checkpoint.pt", None)(stopped)
    assert logx.recorded(Flags, {"resume": str(stopped)}).name == stopped.name


@pytest.mark.root
@pytest.mark.parametrize("kilobytes", [8, 40])  # too small for a checkpoint, and for the curves of a long run
def test_a_full_disk_ends_the_run_with_bad_input_and_what_was_saved_stays(tmp_path, kilobytes):
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", disk], check=True)
    try:
        says = "cannot write .*; go on from its last checkpoint"
        with pytest.raises(BadInput, match=says), folder_of(disk / "a") as run:
            run.begin()
            for t in range(1, 10_000):
                log_episode(run, t)
                if t % 100 == 0:
                    run.save({"t": t, "tensor": torch.zeros(1000)}, {})
        subprocess.run(["mount", "-o", "remount,size=100m", disk], check=True)
        with folder_of(disk / "a", resume=True) as run:
            known = run.checkpoint["t"] if run.checkpoint else 0
            run.begin()
            assert len(first_column(run.folder / "episodes.csv")) == 1 + known and bool(known) == (kilobytes == 40)
    finally:
        subprocess.run(["umount", "-l", disk], check=True)
