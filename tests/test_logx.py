"""logx.py: flags from a dataclass, exit codes, files that are always whole, safe loading, versions."""

import io
import os
import pickle
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

import logx
from ddpg_demoease import Flags
from logx import BadInput, flag


@dataclass
class Kinds:
    """One field of every kind."""

    task: str = flag("a", choices=("a", "b"))
    recipe: str | None = flag(None, "help of recipe", ("x", "y"))
    epochs: int = flag(3, low=1, high=5)
    batch_size: int | None = flag(None, low=0)
    rate: float = flag(0.5)
    sizes: tuple[int, ...] | None = flag(None, "help of sizes", low=1)
    start: tuple[float, float, float] | None = flag(None)
    words: tuple[str, ...] = flag(("one", "two"), "100 % of them", choices=("one", "two"))
    out: Path = flag(Path("here"))
    fast: bool = flag(False)
    maybe: bool | None = flag(None)
    either: bool | str = flag(False, metavar="FOLDER")
    set_by_hand: str = ""


def parse(*argv):
    return logx.parse_flags(Kinds, "What it does.", list(argv))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# ---- flags -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("argv, field, value", [
    (["--task", "b"], "task", "b"),
    (["--recipe", "y"], "recipe", "y"),
    (["--epochs", "5"], "epochs", 5),
    (["--rate", "1e-3"], "rate", 1e-3),
    (["--sizes", "128", "512", "128"], "sizes", (128, 512, 128)),
    (["--start", "-1.5", "0", "1"], "start", (-1.5, 0.0, 1.0)),
    (["--words", "two"], "words", ("two",)),
    (["--out", "a/b"], "out", Path("a/b")),
    (["--fast"], "fast", True),
    (["--maybe"], "maybe", True),
    (["--no-maybe"], "maybe", False),
    (["--either"], "either", True),
    (["--either", "a/b"], "either", "a/b"),
])  # fmt: skip
def test_a_field_is_a_flag_of_its_annotated_type_and_the_others_keep_their_defaults(argv, field, value):
    assert parse() == Kinds()
    assert parse(*argv) == Kinds(**{field: value}) and type(getattr(parse(*argv), field)) is type(value)


@pytest.mark.parametrize("argv, says", [
    (["--task", "c"], "--task"),
    (["--words", "three"], "--words"),
    (["--epochs", "2.5"], "--epochs"),
    (["--sizes", "1", "x"], "--sizes"),
    (["--sizes"], "--sizes"),
    (["--start", "1", "2"], "--start"),
    (["--out", ""], "--out: must name a file or folder"),
    (["--fast", "yes"], "yes: no such flag"),
    (["--epochs", "0"], "--epochs 0: must be at least 1 and at most 5"),
    (["--epochs", "6"], "--epochs 6: must be at least 1 and at most 5"),
    (["--batch_size", "-1"], "--batch_size -1: must be at least 0"),
    (["--sizes", "4", "0"], "--sizes 0: must be at least 1"),
    (["--rate", "nan"], "--rate nan: must be a finite number"),
    (["--rate", "inf"], "--rate inf: must be a finite number"),
    (["--batch-size", "1"], "--batch-size: no such flag; did you mean --batch_size?"),
    (["--batchsize=1"], "--batchsize: no such flag; did you mean --batch_size?"),
    (["--epoch", "4"], "--epoch: no such flag; did you mean --epochs?"),  # no abbreviations
    (["--zzz"], "--zzz: no such flag; --help lists them"),
])  # fmt: skip
def test_a_value_that_is_not_allowed_is_named_with_what_is(argv, says):
    with pytest.raises(BadInput) as refused:
        parse(*argv)
    assert says in str(refused.value)


def test_flags_made_in_python_are_checked_alike():
    with pytest.raises(BadInput, match="--task c: must be one of a, b"):
        logx.check_flags(Kinds(task="c"))


def test_help_shows_the_docstring_every_flag_and_its_default(capsys):
    with pytest.raises(SystemExit) as stopped:
        parse("--help")
    out = " ".join(capsys.readouterr().out.split())
    assert stopped.value.code == 0 and "What it does." in out and "100 % of them (default: one two)" in out
    assert all(f"--{name}" in out for name in vars(Kinds()) if name != "set_by_hand") and "--no-maybe" in out
    assert "set_by_hand" not in out


DEFAULTS = dict(num_demos=100, lambda_bc=2.0, symmetry="gas", demo_noise=0.0, epochs=10)


def filled(**changes):
    return logx.fill_in(Flags(recipe="paper", **changes), DEFAULTS, "ddpg")


def test_what_is_not_given_is_decided_by_task_and_recipe_and_what_differs_is_in_the_name():
    flags = filled()
    assert (flags.num_demos, flags.symmetry, flags.epochs) == (100, "gas", 10)
    assert flags.variant == "" and flags.name == "p2p-ddpg-paper-N100-lambda2-gas-seed0"
    flags = filled(gamma=0.9, hidden_sizes=(8, 4), num_demos=0, epochs=3, seed=5)
    assert flags.variant == "gamma=0.9-hidden_sizes=8x4"
    assert flags.name == "p2p-ddpg-paper-N0-lambda2-gas-gamma=0.9-hidden_sizes=8x4-epochs=3-seed5"
    assert filled(quiet=False, device="cpu", resume=True).name == filled().name


def test_demonstrations_of_a_file_are_named_by_it_and_not_by_how_they_would_be_recorded():
    for given in ({"gains": "fast"}, {"demo_noise": 0.2}):
        with pytest.raises(BadInput, match=f"--{next(iter(given))} .*does not go with --demos"):
            filled(demos="some/file.npz", **given)
    with pytest.raises(BadInput, match="--demos some/file.npz: --num_demos 0 takes none"):
        filled(demos="some/file.npz", num_demos=0)
    flags = filled(demos="some/file.npz")
    assert (flags.variant, flags.gains, flags.demo_noise) == ("demos=file.npz", None, None)


def test_a_long_variant_is_a_number_that_tells_variants_apart():
    one, other = (filled(hidden_sizes=(10,) * 40, gamma=gamma) for gamma in (0.9, 0.8))
    assert one.variant.startswith("2-changes-") and len(one.name) < 100 and one.name != other.name


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "x" * 201])
def test_a_name_that_is_no_folders_is_refused(name):
    with pytest.raises(BadInput, match="--name .*: must be the name of one folder"):
        logx.fill_in(Flags(recipe="paper", name=name), DEFAULTS, "ddpg")


# ---- exit codes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("raised, code, line", [
    (None, 1, ""),
    (BadInput("--x 1:\nmust be 2"), 2, "script.py: error: --x 1: must be 2\n"),
    (logx.NotFinite("NaN"), 3, "script.py: error: NaN\n"),
    (KeyboardInterrupt("state saved"), 130, "script.py: state saved\n"),
    (KeyboardInterrupt(), 130, "script.py: interrupted\n"),
])  # fmt: skip
def test_a_script_ends_with_an_exit_code_and_at_most_one_line(monkeypatch, capsys, raised, code, line):
    def main():
        if raised:
            raise raised
        return 1

    monkeypatch.setattr(sys, "argv", ["some/script.py"])
    with pytest.raises(SystemExit) as ended:
        logx.run_script(main)
    assert ended.value.code == code and capsys.readouterr() == ("", line)


# ---- whole files -----------------------------------------------------------------------------------------------------


def test_atomic_write_leaves_the_old_file_whole_when_the_writer_raises(tmp_path):
    path = tmp_path / "file"
    logx.atomic_write(path, "old")

    def half(file):
        file.write(b"ne")
        file.flush()
        assert path.read_bytes() == b"old"  # also for a reader in the middle of it
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        logx.atomic_write(path, half)
    assert contents(tmp_path) == {"file": b"old"}
    logx.atomic_write(path, b"new")
    assert contents(tmp_path) == {"file": b"new"}


def test_atomic_write_is_on_the_disk_before_it_is_in_place(tmp_path, monkeypatch):
    order, fsync, rename = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda f: order.append(os.fstat(f).st_size) or fsync(f))
    monkeypatch.setattr(os, "replace", lambda a, b: order.append(str(b)) or rename(a, b))
    logx.atomic_write(tmp_path / "file", lambda file: file.write(b"12345"))
    assert order == [5, str(tmp_path / "file")]


# ---- safe loading ----------------------------------------------------------------------------------------------------


class Object:
    """Not a plain type."""


def saved(value, **options):
    file = io.BytesIO()
    torch.save(value, file, **options)
    return file.getvalue()


WHOLE = saved({"w": torch.arange(1000.0), "n": 3})


@pytest.mark.filterwarnings("error")  # a warning is a second line on standard error
@pytest.mark.parametrize("data", [
    b"", WHOLE[:100], WHOLE[:-1], saved({"w": Object()}), saved({"w": Object()}, _use_new_zipfile_serialization=False),
    pickle.dumps(Object()), b"cposix\nsystem\n(S'true'\ntR.", b"epoch,env_steps\n1,2000\n", bytes(5000),
    b"PK\x05\x06" + bytes(18), np.random.default_rng(0).bytes(100),
], ids="empty cut cut-by-one object old-object pickle command text zeros zip random".split())  # fmt: skip
def test_load_torch_refuses_with_a_line_that_names_the_file(tmp_path, data):
    path = tmp_path / "file.pt"
    path.write_bytes(data)
    with pytest.raises(BadInput) as refused:
        logx.load_torch(path)
    assert str(refused.value).startswith(f"{path}: cut short, or holds more than tensors")


def test_load_torch_says_when_there_is_no_file_and_gives_tensors_and_plain_types_back(tmp_path):
    with pytest.raises(BadInput, match=f"{tmp_path}/missing.pt: no such file"):
        logx.load_torch(tmp_path / "missing.pt")
    state = {"t": torch.arange(3.0), "nested": [{"n": 1, "s": "x", "none": None, "yes": True, "f": 0.1}]}
    (tmp_path / "f.pt").write_bytes(saved(state))
    loaded = logx.load_torch(tmp_path / "f.pt")
    assert torch.equal(loaded.pop("t"), state.pop("t")) and loaded == state


# ---- versions --------------------------------------------------------------------------------------------------------


def test_versions_name_the_packages_the_commit_and_whether_a_tracked_file_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(logx, "__file__", str(tmp_path / "logx.py"))
    made_with = logx.versions()
    assert torch.__version__.startswith(made_with["torch"]) and made_with["numpy"] == np.__version__
    assert made_with["git_commit"] == "unknown"  # no repository

    def git(*argv):
        me = ["-c", "user.name=n", "-c", "user.email=e@x", "-c", "commit.gpgsign=false"]
        return subprocess.run(["git", "-C", tmp_path, *me, *argv], check=True, capture_output=True, text=True).stdout

    git("init", "-q")
    (tmp_path / "logx.py").write_text("1\n")
    git("add", "logx.py")
    git("commit", "-q", "-m", "m")
    commit = git("rev-parse", "HEAD").strip()
    git("tag", "-a", "v1", "-m", "m")
    assert logx.versions()["git_commit"] == commit  # not the tag's name
    (tmp_path / "logx.py").write_text("2\n")
    assert logx.versions()["git_commit"] == f"{commit}-dirty"


def test_versions_do_without_git_and_without_a_package(monkeypatch):
    def no_package(name):
        raise logx.PackageNotFoundError(name)

    monkeypatch.setattr(logx, "version", no_package)
    monkeypatch.setenv("PATH", "")
    assert "pybullet" not in logx.versions() and logx.versions()["git_commit"] == "unknown"
