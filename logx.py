"""A run's folder: what was asked (config.json), its curves (episodes.csv, progress.csv) and its checkpoint.

    flags = logx.parse_flags(Flags, __doc__)          # a dataclass of typed flags, as a command line
    run = logx.Run(folder, config)                    # goes on from run.checkpoint, where it is not None
    run.write("episodes", {...}); run.write("progress", {...}); run.save(state, config, policy)

What is on disk is always whole: files are written beside their place, fsynced and renamed, and on a resume the curves
are cut back to the checkpoint they belong to, so that a killed and resumed run equals one that was never killed.
"""

import argparse
import contextlib
import csv
import dataclasses
import fcntl
import json
import math
import os
import platform
import subprocess
import sys
import time
import types
import typing
import warnings
import zlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

EPISODES = ["episode", "env_steps", "return", "length", "success", "collision"]
PROGRESS = ["epoch", "env_steps", "demo_env_steps", "seconds", "EpRet", "EpLen", "Success", "L_O", "L_BC", "L_C", "L_A"]
PROGRESS += ["mask_fraction", "Q_mean", "Q_max", "pretanh_own", "pretanh_demo", "bc_relative_error"]
PROGRESS += ["eval_success", "eval_return"]


def fail(message):
    """Bad input: one line on standard error, exit code 2."""
    print(f"{Path(sys.argv[0]).name}: error: {message}", file=sys.stderr)
    raise SystemExit(2)


def parse_flags(cls, doc, argv=None):
    """The command line of a dataclass: a field is a flag, its annotation the type, metadata the help and the choices.

    `X | None` fields default to what the task or recipe says; bools become --flag and --no-flag; tuples take spaces.
    """
    parser = argparse.ArgumentParser(
        description=doc, usage=argparse.SUPPRESS, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for field in dataclasses.fields(cls):
        kind = typing.get_type_hints(cls)[field.name]
        if isinstance(kind, types.UnionType):
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        options = {"default": field.default, "help": field.metadata.get("help")}
        if kind is bool:
            options["action"] = argparse.BooleanOptionalAction
        elif typing.get_origin(kind) is tuple:
            options |= {"type": int, "nargs": "+"}
        else:
            options |= {"type": kind, "choices": field.metadata.get("choices")}
        parser.add_argument(f"--{field.name}", **options)
    return cls(**vars(parser.parse_args(argv)))


def path(text):
    """The type of a flag that names a file or folder."""
    if not text:
        raise argparse.ArgumentTypeError("must name a file or folder")
    return Path(text)


def flag(default, help=None, choices=None, low=None, high=None):
    """A dataclass field that is a command-line flag; low and high are the smallest and largest allowed values."""
    return dataclasses.field(default=default, metadata=dict(help=help, choices=choices, low=low, high=high))


def check_ranges(flags):
    """Exits with 2 and a line that names the flag where a number is outside what its field allows."""
    for field in dataclasses.fields(flags):
        low, high = field.metadata.get("low"), field.metadata.get("high")
        value = getattr(flags, field.name)
        for x in value if isinstance(value, (tuple, list)) else (value,):
            if x is None or isinstance(x, (bool, str)):
                continue
            if not math.isfinite(x) or (low is not None and x < low) or (high is not None and x > high):
                allowed = " and ".join(
                    f"at {word} {bound}" for word, bound in (("least", low), ("most", high)) if bound is not None
                )
                finite = "" if math.isfinite(x) else "a finite number" + " " * bool(allowed)
                fail(f"--{field.name} {x}: must be {finite}{allowed}")


# What a table's column and a run's seed say, and what does not change what is learned: all else makes a variant.
NOT_A_VARIANT = {"task", "recipe", "num_demos", "lambda_bc", "symmetry", "seed", "epochs", "name", "data_dir", "resume"}
NOT_A_VARIANT |= {"device", "eval_every", "eval_trials", "checkpoint_every", "quick", "quiet", "tensorboard"}


def name_run(flags, printed, algo):
    """Gives the flags a name where they have none. Returns the variant: what differs from `printed`, the recipe's own.
    Exits with 2 where the name is no folder's or the device is not here."""
    asked = dataclasses.asdict(flags).items()
    changed = {key: value for key, value in asked if key not in NOT_A_VARIANT and value != getattr(printed, key)}
    if flags.demos is not None:  # what they were recorded with is said by the file, not by these flags
        flags.gains = flags.demo_noise = None
        changed = {key: value for key, value in changed.items() if key not in ("gains", "demo_noise")}
        changed["demos"] = Path(flags.demos).name
    variant = "-".join(f"{k}={v}" for k, v in changed.items()).replace(" ", "").replace("/", "_")
    if len(variant) > 80:
        variant = f"{len(changed)}-changes-{zlib.crc32(variant.encode()):08x}"
    if flags.name is None:
        flags.name = f"{flags.task}-{algo}-{flags.recipe}-N{flags.num_demos}-lambda{flags.lambda_bc:g}-{flags.symmetry}"
        flags.name += f"{'-' * bool(variant)}{variant}-seed{flags.seed}{'-quick' * flags.quick}"
    if "/" in flags.name or flags.name in ("", ".", "..") or len(flags.name.encode()) > 200:
        fail(f"--name {flags.name!r}: must be the name of one folder, 200 letters at most")
    if not flags.data_dir:
        fail("--data_dir '': must be a folder; . is the present one")
    if flags.device == "cuda":
        import torch

        if not torch.cuda.is_available():
            fail("--device cuda: torch sees no GPU here; use --device cpu")
    return variant


def atomic_write(path, write):
    """Calls write(file) on a binary file beside `path`, then puts it in place whole (fsync, rename)."""
    temporary = Path(f"{path}.part")
    try:
        with open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def versions():
    """What a run was made with: packages, Python, machine, git commit ("-dirty" with uncommitted changes)."""
    made_with = {"python": platform.python_version(), "platform": platform.platform()}
    for package in ("torch", "numpy", "gymnasium", "pybullet"):
        try:
            made_with[package] = version(package)
        except PackageNotFoundError:
            made_with[package] = "unknown"
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    except OSError:  # no git here
        commit = ""
    return made_with | {"git_commit": commit or "unknown"}


def load_torch(path):
    """torch.load of tensors and plain types only. Raises ValueError with what is wrong with the file."""
    import torch  # here and below: seconds, which scripts that do not learn are spared

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file") from None
    except (PermissionError, IsADirectoryError) as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except Exception:  # garbled bytes end in an exception of any kind
        raise ValueError(f"{path}: cut short, or holds more than tensors and plain types (and is not loaded)") from None


def one_line(error):
    """An exception as one line."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def is_new(folder, resume):
    """Whether a run in this folder starts from nothing (else: from its checkpoint); exits with 2 if it may not."""
    try:
        if folder.exists() and not folder.is_dir():
            fail(f"--name {folder.name}: {folder} is a file")
        if folder.exists() and any(folder.iterdir()) and not resume:
            fail(f"--name {folder.name}: {folder} exists; go on with --resume, or choose another --name")
        return not (folder / "checkpoint.pt").exists()
    except OSError as error:
        fail(f"--name {folder.name}: {folder} cannot be read ({error.strerror})")


FORMAT = 2  # of a checkpoint: raised where older ones cannot go on


class Run:
    """One run folder, held until the process ends; goes on from the checkpoint there, if any. What is wrong with the
    folder, another process that holds it included, exits with 2."""

    def __init__(self, folder, config, tensorboard=False):
        self.folder = Path(folder)
        if tensorboard:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError:
                fail("--tensorboard: the tensorboard package is not installed (pip install tensorboard)")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = open(self.folder / "lock", "w")  # noqa: SIM115 - held until the process ends
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fail(f"--name {self.folder.name}: another process is running {self.folder}")
        except OSError as error:
            fail(f"--data_dir {self.folder.parent}: cannot write there ({error.strerror})")
        self.checkpoint = None
        if (self.folder / "checkpoint.pt").exists():
            try:
                self.checkpoint = load_torch(self.folder / "checkpoint.pt")
                self._same_run(config)
            except ValueError as error:
                fail(f"--resume: {error}")
        self._files = {}
        with self._whole():
            for name, columns in (("episodes", EPISODES), ("progress", PROGRESS)):
                path = self.folder / f"{name}.csv"
                if self.checkpoint:
                    size = self.checkpoint["log_bytes"][name]
                    if not path.exists() or path.stat().st_size < size:
                        fail(f"--resume: {path} is gone or shorter than its checkpoint says ({size} bytes)")
                    os.truncate(path, size)  # rows after the checkpoint are made again
                else:
                    path.write_text(",".join(columns) + "\n")
                self._files[name] = open(path, "a", newline="", buffering=1)  # noqa: SIM115
            self._write_config(config)
        self.seconds_before = self.checkpoint["seconds"] if self.checkpoint else 0.0
        self._begin = time.monotonic()
        self._board = SummaryWriter(self.folder) if tensorboard else None

    @contextlib.contextmanager
    def _whole(self):
        """Around what writes: a full disk ends the run with 2 and one line; what was saved before stays as it is."""
        try:
            yield
        except (OSError, RuntimeError) as error:  # torch.save turns the one into the other
            print(f"{Path(sys.argv[0]).name}: error: --data_dir {self.folder.parent}: cannot write {self.folder} "
                  f"({one_line(error)}); go on from its last checkpoint with --resume", file=sys.stderr)  # fmt: skip
            sys.stderr.flush()
            os._exit(2)  # the curves' files would try to write once more

    def _write_config(self, config):
        """config.json: the flags, the command and the versions; those of a resume too, where they are others."""
        path, made_with = self.folder / "config.json", versions()
        text = config | {"command": sys.argv, "versions": made_with}
        if self.checkpoint:
            before = self._config
            text = (text if config["epochs"] > before["epochs"] else before) | {"versions": before["versions"]}
            resumed = before.get("resumed_with", [])
            if made_with != [before["versions"], *resumed][-1]:
                text["resumed_with"] = [*resumed, made_with]
        atomic_write(path, lambda file: file.write(json.dumps(text, indent=1).encode()))

    def _same_run(self, config):
        """A checkpoint continues only the run it was made by: every flag but how long and how loud must agree."""
        free = {"resume", "quiet", "epochs", "name", "data_dir", "tensorboard", "checkpoint_every", "eval_every",
                "eval_trials", "device"}  # fmt: skip
        path, parts = self.folder / "checkpoint.pt", {"config", "log_bytes", "seconds"}
        made_with = self.checkpoint if isinstance(self.checkpoint, dict) else {}
        if made_with.get("format", 1) != FORMAT or not parts <= set(made_with):
            raise ValueError(f"{path}: of another version of this code; begin a new --name")
        before = json.loads(made_with["config"])
        if before.get("algo") != config.get("algo"):
            raise ValueError(f"{path}: a run of {before.get('algo')}, not of {config.get('algo')}")
        for key in sorted(set(config) | set(before)):
            if key not in free and json.dumps(config.get(key)) != json.dumps(before.get(key)):
                raise ValueError(f"{path}: made with --{key} {before.get(key)}, not {config.get(key)}")
        path = self.folder / "config.json"
        try:
            self._config = json.loads(path.read_text())
            self._config["versions"], self._config["epochs"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: a run's settings as JSON are expected ({one_line(error)})") from None

    def seconds(self):
        """Wall-clock seconds of the run, earlier parts included."""
        return self.seconds_before + time.monotonic() - self._begin

    def write(self, name, row):
        """Appends a row (dict by column; None and NaN are left blank) to "episodes" or "progress"."""
        columns = EPISODES if name == "episodes" else PROGRESS
        values = [row.get(column) for column in columns]
        with self._whole():
            csv.writer(self._files[name], lineterminator="\n").writerow(
                ["" if v is None or v != v else f"{v:.9g}" if isinstance(v, float) else v for v in values]
            )
        if self._board and name == "progress":
            for column, v in zip(columns, values, strict=True):
                if v is not None:
                    self._board.add_scalar(column, v, row["env_steps"])

    def save(self, state, config, policy):
        """Writes checkpoint.pt, `state` (tensors and plain types) and what a resume needs of the folder itself, and
        policy.pt."""
        import torch

        with self._whole():
            sizes = {}
            for name, file in self._files.items():
                file.flush()
                os.fsync(file.fileno())
                sizes[name] = os.fstat(file.fileno()).st_size
            state = state | {"log_bytes": sizes, "seconds": self.seconds(), "config": json.dumps(config)}
            state["format"] = FORMAT
            atomic_write(self.folder / "checkpoint.pt", lambda file: torch.save(state, file))
            atomic_write(self.folder / "policy.pt", lambda file: torch.save(policy, file))
