"""logx.py: flags from a dataclass, files that are always whole, a run's folder, and safe loading."""

import io
import json
import math
import os
import pickle
import random
import re
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

import logx
from logx import flag

CONFIG = {"task": "p2p", "gamma": 0.99, "seed": 0, "hidden_sizes": (16, 16), "epochs": 5, "name": "a"}


@dataclass
class Flags:
    """One field of every kind."""

    task: str = flag("a", choices=("a", "b"))
    recipe: str | None = flag(None, "help of recipe", ("x", "y"))
    epochs: int = flag(3, low=1, high=5)
    count: int | None = flag(None, low=0)
    rate: float = flag(0.5)
    gain: float | None = flag(None, low=0)
    sizes: tuple[int, ...] | None = flag(None, "help of sizes", low=1)
    fast: bool = flag(False)
    maybe: bool | None = flag(None)


def parse(*argv):
    return logx.parse_flags(Flags, "What it does.", list(argv))


def error_line(capsys, call, *args, **kwargs):
    """What a call says on bad input: exit code 2, nothing on standard output, one line on standard error."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        call(*args, **kwargs)
    out, err = capsys.readouterr()
    assert stopped.value.code == 2 and not out and err.count("\n") == 1, (stopped.value.code, out, err)
    return err


def begin(folder, config, resume=False, tensorboard=False):
    """A run as the training scripts begin it."""
    logx.is_new(folder, resume)
    return logx.Run(folder, config, tensorboard)


def close(run):
    """Lets go of a run's folder as the end of its process does."""
    for file in (run._lock, *run._files.values()):
        file.close()


def text(path):
    return path.read_bytes().decode()


# ---- flags -----------------------------------------------------------------------------------------------------------


def test_an_empty_command_line_gives_every_default():
    assert parse() == Flags()


@pytest.mark.parametrize("argv, field, value", [
    (["--task", "b"], "task", "b"),
    (["--recipe", "y"], "recipe", "y"),
    (["--epochs", "4"], "epochs", 4),
    (["--count", "7"], "count", 7),
    (["--rate", "1e-3"], "rate", 1e-3),
    (["--gain", "2"], "gain", 2.0),
    (["--fast"], "fast", True),
    (["--fast", "--no-fast"], "fast", False),
    (["--maybe"], "maybe", True),
    (["--no-maybe"], "maybe", False),
])  # fmt: skip
def test_a_field_is_a_flag_of_its_annotated_type(argv, field, value):
    flags = parse(*argv)
    assert getattr(flags, field) == value and type(getattr(flags, field)) is type(value)
    setattr(flags, field, getattr(Flags(), field))
    assert flags == Flags()  # and no other field changed


def test_a_tuple_takes_its_numbers_separated_by_spaces():
    assert list(parse("--sizes", "128", "512", "128").sizes) == [128, 512, 128]


@pytest.mark.parametrize("argv, named", [
    (["--task", "c"], "--task"),
    (["--recipe", "z"], "--recipe"),
    (["--epochs", "2.5"], "--epochs"),
    (["--count", "many"], "--count"),
    (["--gain", "x"], "--gain"),
    (["--sizes", "1", "x"], "--sizes"),
    (["--sizes"], "--sizes"),
    (["--fast", "yes"], "yes"),
    (["--nonsense", "1"], "--nonsense"),
])  # fmt: skip
def test_a_value_of_another_type_or_choice_is_one_line_that_names_the_flag(capsys, argv, named):
    assert named in error_line(capsys, parse, *argv)


def test_help_shows_the_docstring_every_flag_and_the_help_texts(capsys):
    with pytest.raises(SystemExit) as stopped:
        parse("--help")
    out = capsys.readouterr().out
    assert stopped.value.code == 0 and "What it does." in out and "help of recipe" in out and "help of sizes" in out
    assert all(f"--{name}" in out for name in vars(Flags())) and "--no-fast" in out and "--no-maybe" in out


@pytest.mark.parametrize("changed, message", [
    (dict(epochs=0), "--epochs 0: must be at least 1 and at most 5"),
    (dict(epochs=6), "--epochs 6: must be at least 1 and at most 5"),
    (dict(count=-1), "--count -1: must be at least 0"),
    (dict(gain=-0.5), "--gain -0.5: must be at least 0"),
    (dict(sizes=(4, 0, 2)), "--sizes 0: must be at least 1"),
])  # fmt: skip
def test_a_number_out_of_range_is_named_with_what_is_allowed(capsys, changed, message):
    assert error_line(capsys, logx.check_ranges, Flags(**changed)).strip().endswith(message)


@pytest.mark.parametrize("field", ["rate", "gain"])  # without bounds and with one
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nan_and_infinity_are_out_of_every_range(capsys, field, value):
    line = error_line(capsys, logx.check_ranges, Flags(**{field: value}))
    assert f"--{field} {value}: must be a finite number" in line


def test_the_bounds_themselves_and_what_is_not_given_are_in_range():
    for changed in (dict(), dict(epochs=1), dict(epochs=5), dict(count=0, gain=0.0, sizes=(1, 1), rate=-1e9)):
        assert logx.check_ranges(Flags(**changed)) is None


# ---- whole files -----------------------------------------------------------------------------------------------------


def test_atomic_write_leaves_the_old_file_whole_when_the_writer_raises(tmp_path):
    path = tmp_path / "file"
    logx.atomic_write(path, lambda file: file.write(b"old"))

    def half(file):
        file.write(b"ne")
        file.flush()
        assert path.read_bytes() == b"old"  # also for a reader in the middle of it
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        logx.atomic_write(path, half)
    assert path.read_bytes() == b"old"
    logx.atomic_write(path, lambda file: file.write(b"new"))  # and what the failed one left is not in the way
    assert path.read_bytes() == b"new" and [p.name for p in tmp_path.iterdir()] == ["file"]


def test_atomic_write_is_on_the_disk_before_it_is_in_place(tmp_path, monkeypatch):
    order = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda f: order.append(("fsync", os.fstat(f).st_size)) or fsync(f))
    monkeypatch.setattr(os, "replace", lambda a, b: order.append(("replace", str(b))) or replace(a, b))
    logx.atomic_write(tmp_path / "file", lambda file: file.write(b"12345"))
    assert order == [("fsync", 5), ("replace", str(tmp_path / "file"))]


# ---- safe loading ----------------------------------------------------------------------------------------------------


class Object:
    """Not a plain type."""


def unloadable():
    """{what: bytes of a file that load_torch must refuse}."""
    whole = io.BytesIO()
    torch.save({"w": torch.arange(1000.0), "n": 3}, whole)
    whole = whole.getvalue()
    pickled = io.BytesIO()
    torch.save({"w": Object()}, pickled)
    legacy = io.BytesIO()
    torch.save({"w": Object()}, legacy, _use_new_zipfile_serialization=False)
    files = {f"cut at {n}": whole[:n] for n in (0, 1, 4, 100, len(whole) // 2, len(whole) - 1)}
    return files | {
        "an object saved by torch": pickled.getvalue(),
        "an object in torch's old format": legacy.getvalue(),
        "an object saved by pickle": pickle.dumps(Object()),
        "a pickle that runs a command": b"cposix\nsystem\n(S'true'\ntR.",
        "text": b"epoch,env_steps\n1,2000\n",
        "one line feed": b"\n",
        "zeros": bytes(5000),
        "another zip": b"PK\x05\x06" + bytes(18),
    }


@pytest.mark.filterwarnings("error")  # a warning is a second line on standard error
@pytest.mark.parametrize("what", unloadable())
def test_load_torch_refuses_with_a_line_that_names_the_file(tmp_path, what):
    path = tmp_path / "file.pt"
    path.write_bytes(unloadable()[what])
    with pytest.raises(ValueError) as refused:
        logx.load_torch(path)
    line = str(refused.value)
    assert line.startswith(f"{path}: cut short, or holds more than tensors") and "\n" not in line


@pytest.mark.filterwarnings("error")
def test_load_torch_refuses_any_text_and_any_bytes(tmp_path):
    draw = random.Random(0)
    for alphabet in (b"abcdefghijklmnopqrstuvwxyz0123456789 ,.-()[]{}\n", bytes(range(256))):
        for _ in range(100):
            (tmp_path / "file.pt").write_bytes(bytes(draw.choices(alphabet, k=draw.randint(1, 100))))
            with pytest.raises(ValueError, match="file.pt"):
                logx.load_torch(tmp_path / "file.pt")


def test_load_torch_says_when_there_is_no_file_and_when_it_is_a_folder(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path}/missing.pt: no such file"):
        logx.load_torch(tmp_path / "missing.pt")
    with pytest.raises(ValueError, match=f"{tmp_path}: Is a directory"):
        logx.load_torch(tmp_path)


def test_load_torch_gives_tensors_and_plain_types_back(tmp_path):
    state = {"t": torch.arange(3.0), "nested": [{"n": 1, "s": "x", "none": None, "yes": True, "f": 0.1}]}
    logx.atomic_write(tmp_path / "f.pt", lambda file: torch.save(state, file))
    loaded = logx.load_torch(tmp_path / "f.pt")
    assert torch.equal(loaded.pop("t"), state.pop("t")) and loaded == state


# ---- versions --------------------------------------------------------------------------------------------------------


def test_versions_name_the_packages_that_are_running():
    import platform

    import gymnasium
    import numpy

    made_with = logx.versions()
    assert made_with["python"] == platform.python_version() and made_with["torch"] == torch.__version__
    assert made_with["numpy"] == numpy.__version__ and made_with["gymnasium"] == gymnasium.__version__
    assert re.fullmatch(r"3\.\d+\.\d+", made_with["pybullet"])


def test_versions_name_the_commit_and_say_dirty_where_a_tracked_file_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(logx, "__file__", str(tmp_path / "logx.py"))
    assert logx.versions()["git_commit"] == "unknown"  # no repository

    def git(*argv):
        me = ["-c", "user.name=n", "-c", "user.email=e@x", "-c", "commit.gpgsign=false"]
        return subprocess.run(["git", "-C", tmp_path, *me, *argv], check=True, capture_output=True, text=True).stdout

    git("init", "-q")
    (tmp_path / "logx.py").write_text("1\n")
    git("add", "logx.py")
    git("commit", "-q", "-m", "m")
    commit = git("rev-parse", "HEAD").strip()
    assert logx.versions()["git_commit"] == commit
    git("tag", "-a", "v1", "-m", "m")
    assert logx.versions()["git_commit"] == commit  # not the tag's name
    (tmp_path / "logx.py").write_text("2\n")
    assert logx.versions()["git_commit"] == f"{commit}-dirty"


def test_versions_do_without_git_and_without_a_package(monkeypatch):
    real = logx.version

    def version(package):
        if package == "pybullet":
            raise logx.PackageNotFoundError(package)
        return real(package)

    monkeypatch.setattr(logx, "version", version)
    assert logx.versions()["pybullet"] == "unknown"
    monkeypatch.setenv("PATH", "")
    assert logx.versions()["git_commit"] == "unknown"


# ---- a run's folder --------------------------------------------------------------------------------------------------


def test_a_new_run_has_its_config_its_command_and_empty_curves(tmp_path):
    run = begin(tmp_path / "deep" / "a", CONFIG)
    config = json.loads(text(run.folder / "config.json"))
    assert config.pop("command") and config.pop("versions")["torch"] == torch.__version__
    assert config == json.loads(json.dumps(CONFIG)) and run.checkpoint is None
    assert text(run.folder / "episodes.csv") == "episode,env_steps,return,length,success,collision\n"
    assert text(run.folder / "progress.csv") == (
        "epoch,env_steps,demo_env_steps,seconds,EpRet,EpLen,Success,L_O,L_BC,L_C,L_A,mask_fraction,Q_mean,Q_max,"
        "pretanh_own,pretanh_demo,bc_relative_error,eval_success,eval_return\n")  # fmt: skip


def test_write_puts_values_under_their_columns_and_leaves_none_nan_and_missing_blank(tmp_path):
    run = begin(tmp_path / "a", CONFIG)
    run.write("episodes", {"collision": "self", "episode": 1, "env_steps": 88, "return": -2.25, "length": 88,
                           "success": 0})  # fmt: skip
    run.write("progress", {"epoch": 1, "env_steps": 300, "EpRet": None, "L_BC": math.nan, "L_O": -1 / 3, "Q_max": 0.0})
    assert text(run.folder / "episodes.csv").splitlines()[1] == "1,88,-2.25,88,0,self"
    row = text(run.folder / "progress.csv").splitlines()[1]
    assert row == "1,300,,,,,,-0.333333333,,,,,,0,,,,,"  # on the disk at once, without a save


def test_a_resume_cuts_both_curves_back_to_the_checkpoint_and_goes_on_from_there(tmp_path):
    run = begin(tmp_path / "a", CONFIG)
    for n in (1, 2):
        run.write("episodes", {"episode": n})
    run.write("progress", {"epoch": 1})
    run.save({"tensor": torch.arange(3)}, CONFIG, {})
    run.write("episodes", {"episode": 3})
    run.write("progress", {"epoch": 2})
    close(run)
    with open(tmp_path / "a" / "episodes.csv", "a") as file:
        file.write("4,3")  # a row cut off by a kill
    again = begin(tmp_path / "a", CONFIG, resume=True)
    assert torch.equal(again.checkpoint["tensor"], torch.arange(3))
    assert [line.split(",")[0] for line in text(tmp_path / "a" / "episodes.csv").splitlines()] == ["episode", "1", "2"]
    assert [line.split(",")[0] for line in text(tmp_path / "a" / "progress.csv").splitlines()] == ["epoch", "1"]
    again.write("episodes", {"episode": 3})
    assert text(tmp_path / "a" / "episodes.csv").endswith("\n2,,,,,\n3,,,,,\n")


def test_a_run_is_new_until_it_has_a_checkpoint(tmp_path):
    assert logx.is_new(tmp_path / "a", False) and logx.is_new(tmp_path / "a", True)
    (tmp_path / "a").mkdir()
    assert logx.is_new(tmp_path / "a", False) and logx.is_new(tmp_path / "a", True)
    run = begin(tmp_path / "a", CONFIG)
    assert logx.is_new(tmp_path / "a", True)
    run.save({}, CONFIG, {})
    assert not logx.is_new(tmp_path / "a", True)


def test_a_resume_without_a_checkpoint_starts_anew(tmp_path):
    run = begin(tmp_path / "a", CONFIG)
    run.write("episodes", {"episode": 1})
    close(run)
    again = begin(tmp_path / "a", CONFIG, resume=True)
    assert again.checkpoint is None and text(tmp_path / "a" / "episodes.csv").count("\n") == 1


def test_the_seconds_of_a_resumed_run_include_the_earlier_parts(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(logx.time, "monotonic", lambda: now[0])
    run = begin(tmp_path / "a", CONFIG)
    now[0] += 7
    run.save({}, CONFIG, {})
    now[0] += 1000  # not the run's
    close(run)
    again = begin(tmp_path / "a", CONFIG, resume=True)
    now[0] += 5
    assert again.seconds() == 12


def test_a_run_is_not_begun_twice_in_one_folder_but_by_a_resume(tmp_path, capsys):
    run = begin(tmp_path / "a", CONFIG)
    run.write("episodes", {"episode": 1})
    close(run)
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    line = error_line(capsys, begin, tmp_path / "a", CONFIG)
    assert "--resume" in line and "--name" in line
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


def test_a_run_that_is_held_is_refused_until_it_is_let_go(tmp_path, capsys):
    run = begin(tmp_path / "a", CONFIG)
    run.write("episodes", {"episode": 1})
    assert "another process" in error_line(capsys, begin, tmp_path / "a", CONFIG, resume=True)
    assert text(tmp_path / "a" / "episodes.csv").endswith("\n1,,,,,\n")  # the refused one touched nothing
    close(run)
    assert begin(tmp_path / "a", CONFIG, resume=True).checkpoint is None


@pytest.mark.parametrize("key, value", [("gamma", 0.9), ("seed", 1), ("hidden_sizes", (16, 8)), ("task", "pnp")])
def test_a_checkpoint_goes_on_only_with_the_flags_it_was_made_with(tmp_path, capsys, key, value):
    run = begin(tmp_path / "a", CONFIG)
    run.write("episodes", {"episode": 1})
    run.save({}, CONFIG, {})
    run.write("episodes", {"episode": 2})
    close(run)
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    line = error_line(capsys, begin, tmp_path / "a", CONFIG | {key: value}, resume=True)
    assert f"--{key}" in line
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


def test_how_long_how_loud_and_where_may_change_on_a_resume(tmp_path):
    run = begin(tmp_path / "a", CONFIG)
    run.save({}, CONFIG, {})
    close(run)
    changed = CONFIG | dict(epochs=9, name="b", quiet=True, data_dir="x", resume=True, checkpoint_every=2)
    again = begin(tmp_path / "a", changed, resume=True)
    assert again.checkpoint is not None and json.loads(text(tmp_path / "a" / "config.json"))["epochs"] == 9


def test_a_broken_checkpoint_is_named_and_the_curves_are_left_alone(tmp_path, capsys):
    run = begin(tmp_path / "a", CONFIG)
    run.write("episodes", {"episode": 1})
    run.save({"t": torch.zeros(100)}, CONFIG, {})
    close(run)
    path = tmp_path / "a" / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:-50])
    assert str(path) in error_line(capsys, begin, tmp_path / "a", CONFIG, resume=True)
    assert text(tmp_path / "a" / "episodes.csv").endswith("\n1,,,,,\n")


@pytest.mark.parametrize("shorten", [Path.unlink, lambda p: p.write_bytes(p.read_bytes()[:-3])], ids=["gone", "cut"])
def test_a_curve_shorter_than_its_checkpoint_is_refused_by_name(tmp_path, capsys, shorten):
    run = begin(tmp_path / "a", CONFIG)
    run.write("episodes", {"episode": 1})
    run.save({}, CONFIG, {})
    close(run)
    shorten(tmp_path / "a" / "episodes.csv")
    assert "episodes.csv" in error_line(capsys, begin, tmp_path / "a", CONFIG, resume=True)


@pytest.mark.parametrize("where", ["file/a", "file", "x" * 300])
def test_a_folder_that_cannot_be_made_is_one_line(tmp_path, capsys, where):
    (tmp_path / "file").write_text("")
    line = error_line(capsys, begin, tmp_path / where, CONFIG)
    assert "--data_dir" in line or "--name" in line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_tensorboard_that_is_not_installed_is_bad_input_and_leaves_no_folder(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(logx.sys.modules, "torch.utils.tensorboard", None)
    assert "--tensorboard" in error_line(capsys, begin, tmp_path / "a", CONFIG, tensorboard=True)
    assert not list(tmp_path.iterdir())


def test_a_resume_with_other_versions_is_on_record_and_the_first_ones_stay(tmp_path, monkeypatch):
    def record(commit, **changes):
        monkeypatch.setattr(logx, "versions", lambda: {"git_commit": commit})
        logx.Run(tmp_path / "run", CONFIG | changes).save({}, CONFIG | changes, {})
        return json.loads((tmp_path / "run" / "config.json").read_text())

    assert record("one")["versions"] == {"git_commit": "one"}
    assert "resumed_with" not in record("one")
    assert record("two")["resumed_with"] == [{"git_commit": "two"}]
    assert record("two")["resumed_with"] == [{"git_commit": "two"}]
    longer = record("one", epochs=CONFIG["epochs"] + 1)
    assert longer["epochs"] == CONFIG["epochs"] + 1 and longer["versions"] == {"git_commit": "one"}
    assert longer["resumed_with"] == [{"git_commit": "two"}, {"git_commit": "one"}]


def test_a_checkpoint_of_another_format_is_refused_by_name(tmp_path, capsys, monkeypatch):
    logx.Run(tmp_path / "run", CONFIG).save({}, CONFIG, {})
    monkeypatch.setattr(logx, "FORMAT", logx.FORMAT + 1)
    with pytest.raises(SystemExit) as stopped:
        logx.Run(tmp_path / "run", CONFIG)
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert "checkpoint.pt" in error and "another version" in error and error.count("\n") == 1


def test_seconds_do_not_follow_a_clock_that_jumps_back(tmp_path, monkeypatch):
    run = logx.Run(tmp_path / "run", CONFIG)
    monkeypatch.setattr(time, "time", lambda: -1e9)
    assert 0 <= run.seconds() < 100


def spoiled(name, content):
    """Something to do to a run's folder: `content` in place of the file `name`, None for nothing, "/" for a folder."""

    def spoil(folder):
        (folder / name).unlink()
        if content == "/":
            (folder / name).mkdir()
        elif content is not None:
            (folder / name).write_bytes(content)

    return spoil


def stored(value):
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


@pytest.mark.parametrize("spoil, says", [
    (spoiled("config.json", b"{"), "config.json"), (spoiled("config.json", b"[]"), "config.json"),
    (spoiled("config.json", b"{}"), "config.json"), (spoiled("config.json", None), "config.json"),
    (spoiled("checkpoint.pt", stored([1])), "another version"),
    (spoiled("checkpoint.pt", stored({"format": logx.FORMAT})), "another version"),
], ids=["cut", "a list", "empty", "gone", "a checkpoint that is a list", "a checkpoint without its parts"])  # fmt: skip
def test_a_folder_that_cannot_be_gone_on_with_is_one_line(tmp_path, capsys, spoil, says):
    run = begin(tmp_path / "a", CONFIG)
    run.save({}, CONFIG, {})
    close(run)
    spoil(tmp_path / "a")
    error = error_line(capsys, begin, tmp_path / "a", CONFIG, resume=True)
    assert "--resume" in error and says in error and "go on from its last" not in error


def test_a_run_of_the_other_algorithm_is_refused_by_its_name(tmp_path, capsys):
    run = begin(tmp_path / "a", CONFIG | {"algo": "ddpg", "act_noise": 0.1})
    run.save({}, CONFIG | {"algo": "ddpg", "act_noise": 0.1}, {})
    close(run)
    assert "a run of ddpg, not of ppo" in error_line(capsys, begin, tmp_path / "a", CONFIG | {"algo": "ppo"}, True)
