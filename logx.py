"""What all scripts share: flags, bad input, whole files, and a run's folder.

    flags = logx.parse_flags(Flags, __doc__)      # a dataclass as command line
    with logx.RunFolder(flags, "ddpg", columns) as run:
        run.begin(demo_env_steps); run.log_episode(...); run.log_epoch(...)
        run.save(state, policy)
    logx.run_script(main)                         # exit codes of bad input, NaN

A run's folder holds what was asked (config.json), its curves (episodes.csv,
progress.csv), its checkpoint and its policy. What is on disk is always whole:
but for the curves, which grow by lines, files are written beside their place,
fsynced and renamed. On a resume the curves are cut back to the checkpoint, so
that a killed and resumed run equals one that was never killed.
"""

import argparse
import contextlib
import csv
import dataclasses
import difflib
import fcntl
import json
import math
import os
import platform
import signal
import subprocess
import sys
import threading
import time
import types
import typing
import warnings
import zlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import gymnasium
import numpy as np
from tqdm import tqdm

EPISODES = ["episode", "env_steps", "return", "length", "success", "collision"]
PROGRESS = ["epoch", "env_steps", "demo_env_steps", "seconds", "EpRet", "EpLen", "Success"]  # then what is measured,
EVALUATED = ["eval_success", "eval_return"]  # and the validation trials
FORMAT = 5  # of a checkpoint: raised where older ones cannot go on
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)  # the last is what Slurm sends before the time is up


# ---- bad input, exit codes -------------------------------------------------------------------------------------------


class BadInput(ValueError):
    """What a user asked for and cannot have: names the flag or file, says what is wrong and what is allowed."""


class NotFinite(ArithmeticError):
    """A loss, a weight or an action became NaN or infinite."""


def run_script(main):
    """Runs a script's main() and ends the process: 0 done, 2 bad input, 3 NaN, 130 interrupted, each with one line,
    141 where nobody reads its output."""
    code, message = 0, ""
    try:
        code = main() or 0
        sys.stdout.flush()
    except (BadInput, NotFinite) as error:
        code, message = 2 if isinstance(error, BadInput) else 3, f"error: {one_line(error)}"
    except KeyboardInterrupt as interrupt:
        code, message = 130, " ".join(map(str, interrupt.args)) or "interrupted"
    except BrokenPipeError:  # the reader of our output has seen enough
        code = 128 + signal.SIGPIPE
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if message:
        print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    sys.exit(code)


def one_line(error):
    """An exception, or a text, as one line."""
    return " ".join(str(error).split()) or type(error).__name__


# ---- flags -----------------------------------------------------------------------------------------------------------


def flag(default, help=None, choices=None, low=None, high=None, positional=False, metavar=None):
    """A dataclass field that is a command-line flag; low and high are the smallest and largest allowed values."""
    about = dict(help=help, choices=choices, low=low, high=high, positional=positional, metavar=metavar)
    return dataclasses.field(default=default, metadata=about)


def path(text):
    """The type of a flag that names a file or folder."""
    if not text:
        raise argparse.ArgumentTypeError("must name a file or folder")
    return Path(text)


@dataclasses.dataclass
class RunFlags:
    """The flags of every run, whatever the algorithm."""

    name: str | None = flag(None, "of its folder; says task, algorithm, recipe, N, lambda, symmetry, variant, seed")
    data_dir: str = flag("data/runs", "where run folders lie, from the present folder")
    resume: bool | str = flag(False, "go on from the checkpoint, or with the run in FOLDER", metavar="FOLDER")
    device: str = flag("cpu", "where the networks learn", choices=("cpu", "cuda"))
    eval_every: int = flag(5, "epochs between validation trials; 0 never", low=0)
    eval_trials: int = flag(50, "validation trials each time", low=1, high=40_000)
    checkpoint_every: int = flag(5, "epochs between checkpoints", low=1)
    quick: bool = flag(False, "the robust recipe, then test trials and a GIF of the agent")
    quiet: bool = flag(False, "no progress bar and table")
    tensorboard: bool = flag(False, "write TensorBoard's files too")
    variant: str = ""  # what differs from the recipe; set by fill_in
    own_length: bool = True  # whether `epochs` is the recipe's; set by fill_in


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise BadInput(message)


def parse_flags(cls, doc, argv=None):
    """The command line of a dataclass whose fields are made by `flag`: its name is the flag, its annotation the type.

    `X | None` defaults to what the help says; `bool` is --flag, `bool | None` also --no-flag; tuples take spaces;
    `bool | str` may stand alone or with a value. --resume FOLDER takes what is not asked for from the run there (see
    `recorded`). Raises BadInput where a value is not allowed.
    """
    parser = _Parser(description=doc, usage=argparse.SUPPRESS, allow_abbrev=False,
                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    hints = typing.get_type_hints(cls)
    for field in sorted(dataclasses.fields(cls), key=lambda field: field.name not in cls.__annotations__):
        if not field.metadata:
            continue
        about, kind = field.metadata, hints[field.name]
        kinds = [k for k in typing.get_args(kind) if k is not type(None)] if isinstance(kind, types.UnionType) else []
        shown = field.default
        if isinstance(shown, tuple):
            shown = " ".join(map(str, shown))
        default = "" if shown is None or isinstance(shown, bool) or shown == "" else f"(default: {shown})"
        options = {"default": argparse.SUPPRESS, "help": f"{about['help'] or ''} {default}".strip().replace("%", "%%")}
        if kinds == [bool, str]:
            options |= {"nargs": "?", "const": True, "metavar": about["metavar"]}
        elif kind is bool and not field.default:
            options |= {"action": "store_true"}
        elif bool in (kind, *kinds):
            options |= {"action": argparse.BooleanOptionalAction}
        else:
            kind = kinds[0] if kinds else kind
            if typing.get_origin(kind) is tuple:
                kind, *rest = typing.get_args(kind)
                many = "*" if about["positional"] else "+"
                options |= {"nargs": many if rest == [...] else 1 + len(rest)}
            options |= {"type": path if kind is Path else kind, "choices": about["choices"]}
            options |= {"metavar": about["metavar"]} if about["metavar"] else {}
        parser.add_argument(field.name if about["positional"] else f"--{field.name}", **options)
    values, unknown = parser.parse_known_args(argv)
    if unknown:  # --batch-size and --batchsize are told --batch_size
        name = unknown[0].split("=")[0]
        flags = [f"--{field.name}" for field in dataclasses.fields(cls) if field.metadata]
        near = difflib.get_close_matches(name, flags, 1)
        raise BadInput(f"{name}: no such flag" + (f"; did you mean {near[0]}?" if near else "; --help lists them"))
    asked = {name: tuple(value) if isinstance(value, list) else value for name, value in vars(values).items()}
    return check_flags(recorded(cls, asked) if isinstance(asked.get("resume"), str) else cls(**asked))


def check_flags(flags):
    """The flags, as they are. Raises BadInput with the flag's name where a value is outside what its field allows."""
    for field in dataclasses.fields(flags):
        low, high, choices = (field.metadata.get(key) for key in ("low", "high", "choices"))
        value = getattr(flags, field.name)
        for x in value if isinstance(value, (tuple, list)) else (value,):
            if x is not None and choices and x not in choices:
                raise BadInput(f"--{field.name} {x}: must be one of {', '.join(map(str, choices))}")
            if x is None or isinstance(x, (bool, str, Path)):
                if isinstance(x, str) and (low is not None or high is not None):  # of a config.json
                    raise BadInput(f"--{field.name} {x!r}: must be a number")
                continue
            if not abs(x) < math.inf or (low is not None and x < low) or (high is not None and x > high):
                bounds = [f"at {word} {bound}" for word, bound in (("least", low), ("most", high)) if bound is not None]
                allowed = " and ".join(bounds) or "a finite number"
                raise BadInput(f"--{field.name} {x}: must be {allowed}")
    return flags


BOARD = dict(eval="test", EpRet="train", EpLen="train", Success="train", L="loss", epoch="time", env="time",
             demo="time", seconds="time")  # TensorBoard's group of a column, by its first word  # fmt: skip
FREE = {field.name for field in dataclasses.fields(RunFlags)} | {"epochs"}  # a resumed run may differ in these
# These stand elsewhere in names and tables; a difference in any other flag makes a variant.
NOT_A_VARIANT = FREE | {"task", "recipe", "num_demos", "lambda_bc", "symmetry", "seed"}


def recorded(cls, asked):
    """The flags, a `cls`, that the run in the folder asked["resume"] was begun with, but for what is `asked` for now,
    {flag: value}, and how loud it was; newer flags at their default. Raises BadInput where no run of this is there."""
    folder = Path(asked["resume"])
    folder = folder.resolve() if folder.name in ("", "..") else folder
    try:
        config = json.loads((folder / "config.json").read_text())
        fields = {field.name: field.default for field in dataclasses.fields(cls)}
        before = {name: tuple(v) if isinstance(v, list) else v for name, v in config.items() if name in fields}
        if missing := {name for name in fields if fields[name] is None} - set(before):
            raise ValueError(f"its config.json, of {config.get('algo')}, lacks {len(missing)} of this script's flags")
    except (OSError, ValueError, AttributeError) as error:
        raise BadInput(f"--resume {folder}: must be a run's folder ({one_line(error)})") from None
    for name in {"name", "data_dir"} & set(asked):
        raise BadInput(f"--{name} {asked[name]}: does not go with --resume {folder}, which says it")
    where = {"name": folder.name, "data_dir": str(folder.parent)}
    return cls(**(before | {"quiet": False} | asked | where | {"resume": True}))


def fill_in(flags, defaults, algo):
    """A copy of the flags with `defaults`, {flag: value} of task and recipe, in place of None, with a name where there
    is none, and with `variant`, what differs from the recipe. Raises BadInput where flags do not fit or a name is no
    folder's."""
    for key in ("gains", "demo_noise") if flags.demos is not None else ():
        if getattr(flags, key) is not None:
            raise BadInput(f"--{key} {getattr(flags, key)}: is of own recordings, and does not go with --demos")
    if flags.demos is not None and flags.num_demos == 0:
        raise BadInput(f"--demos {flags.demos}: --num_demos 0 takes none of them; at least 1 is allowed, or no --demos")
    recipe = dataclasses.replace(type(flags)(task=flags.task, recipe=flags.recipe), **defaults)
    flags = dataclasses.replace(flags, **{key: v for key, v in defaults.items() if getattr(flags, key) is None})
    flags.own_length = flags.epochs == recipe.epochs
    for each in (flags, recipe) if flags.demos is not None else ():  # the file says what they were recorded with
        each.gains = each.demo_noise = None
    changed = {key: value for key, value in dataclasses.asdict(flags).items()
               if key not in NOT_A_VARIANT and value != getattr(recipe, key)}  # fmt: skip
    changed |= {"demos": Path(flags.demos).name} if flags.demos is not None else {}
    texts = {k: "x".join(map(str, v)) if isinstance(v, (tuple, list)) else str(v) for k, v in changed.items()}
    variant = "-".join(f"{k}={v}" for k, v in texts.items()).replace(" ", "").replace("/", "_")
    flags.variant = variant if len(variant) <= 80 else f"{len(changed)}-changes-{zlib.crc32(variant.encode()):08x}"
    if flags.name is None:
        length = "" if flags.own_length else f"epochs={flags.epochs}"
        words = [flags.task, algo, flags.recipe, f"N{flags.num_demos}", f"lambda{flags.lambda_bc:g}", flags.symmetry]
        flags.name = "-".join([*words, *filter(None, (flags.variant, length)), f"seed{flags.seed}"])
    if "/" in flags.name or flags.name in ("", ".", "..") or len(os.fsencode(flags.name)) > 200:
        raise BadInput(f"--name {flags.name!r}: must be the name of one folder, 200 letters at most")
    if not str(flags.data_dir):
        raise BadInput("--data_dir '': must be a folder; . is the present one")
    if flags.device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise BadInput("--device cuda: torch sees no GPU here; use --device cpu")
    return flags


# ---- files -----------------------------------------------------------------------------------------------------------


def atomic_write(path, write):
    """Calls write(file) on a binary file beside `path`, then puts it in place whole (fsync, rename). `write` may also
    be the text or bytes themselves."""
    temporary = Path(f"{path}.part")
    try:
        with open(temporary, "wb") as file:
            if callable(write):
                write(file)
            else:
                file.write(write.encode() if isinstance(write, str) else write)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def load_torch(path):
    """torch.load of tensors and plain types only. Raises BadInput with what is wrong with the file."""
    import torch  # here and below: seconds, which scripts that do not learn are spared

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file") from None
    except (PermissionError, IsADirectoryError) as error:
        raise BadInput(f"{path}: {error.strerror}") from None
    except Exception:  # garbled bytes end in an exception of any kind
        raise BadInput(f"{path}: cut short, or holds more than tensors and plain types (and is not loaded)") from None


def versions():
    """What a run was made with: packages, Python, machine, CPU, git commit ("-dirty" with uncommitted changes)."""
    made_with = {"python": platform.python_version(), "platform": platform.platform()}
    for package in ("torch", "numpy", "gymnasium", "pybullet", "pybullet-arm64"):  # the last is the other one's fork
        with contextlib.suppress(PackageNotFoundError):
            made_with[package] = version(package)
    if torch := sys.modules.get("torch"):  # on the instructions that it uses the last bits of a curve depend
        made_with["cpu"] = torch.backends.cpu.get_cpu_capability()
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    except OSError:  # no git here
        commit = ""
    return made_with | {"git_commit": commit or "unknown"}


# ---- the environment of a run ----------------------------------------------------------------------------------------


class Replayable(gymnasium.Wrapper):
    """An environment whose unfinished episode fits into a checkpoint: as the random state it began with and the actions
    since, which are played again (PyBullet's state is not enough to go on exactly).

    `episode` holds the steps since reset, (s, a, r, s2, terminated, truncated) each. At its end info["episode"] holds
    the return "r" and the length "l", as with gymnasium's RecordEpisodeStatistics."""

    def __init__(self, env, seed):
        super().__init__(env)
        env.reset(seed=seed)

    def reset(self):
        self._began = self.unwrapped.np_random.bit_generator.state
        self._s, info = self.env.reset()
        self.episode = []
        return self._s, info

    def step(self, action):
        if not np.isfinite(action).all():
            raise NotFinite("an action is NaN or infinite; begin anew with smaller learning rates or less noise")
        s2, r, terminated, truncated, info = self.env.step(action)
        self.episode.append((self._s, action, r, s2, terminated, truncated))
        self._s = s2
        if terminated or truncated:
            info["episode"] = {"r": sum(step[2] for step in self.episode), "l": len(self.episode)}
        return s2, r, terminated, truncated, info

    def state(self):
        return {"began": json.dumps(self._began), "actions": [step[1].tolist() for step in self.episode]}

    def load(self, state):
        """Plays the episode of `state` again. Returns the observation it had come to."""
        self.unwrapped.np_random.bit_generator.state = json.loads(state["began"])
        self.reset()
        for a in state["actions"]:
            self.step(np.array(a, dtype=np.float32))
        return self._s


# ---- a run's folder --------------------------------------------------------------------------------------------------


class RunFolder:
    """One run's folder, held by this process until the `with` block ends; `checkpoint` is None or what was saved.

    flags: of an algorithm script; measured: the names of what `log_updates` is given, which become columns of
    progress.csv. Raises BadInput for whatever is wrong with the folder, another process that holds it included.
    """

    def __init__(self, flags, algo, measured):
        self.flags, self.folder = flags, Path(flags.data_dir) / flags.name
        self.total_steps = flags.epochs * flags.steps_per_epoch
        self.columns = {"episodes": EPISODES, "progress": [*PROGRESS, *measured, *EVALUATED]}
        self._config = json.loads(json.dumps(dataclasses.asdict(flags) | {"algo": algo}, default=str))
        self._files, self._board, self._bar, self.stop_signals = {}, None, None, []
        self._log = {"episodes": 0, "epoch_episodes": [], "epoch_updates": [], "demo_env_steps": 0}
        if flags.tensorboard:
            try:
                import torch.utils.tensorboard  # noqa: F401
            except ImportError:
                raise BadInput("--tensorboard: needs the tensorboard package (pip install tensorboard)") from None
        self._take()

    def _take(self):
        """Holds the folder and reads its checkpoint."""
        folder, name = self.folder, f"--name {self.folder.name}"
        try:
            if folder.exists() and not folder.is_dir():
                raise BadInput(f"{name}: {folder} is a file")
            if folder.exists() and set(os.listdir(folder)) - {"lock", "log.txt"} and not self.flags.resume:
                raise BadInput(f"{name}: {folder} exists; go on with --resume, or choose another --name")
            if list(folder.glob("*.csv.gz")):
                raise BadInput(f"{name}: {folder} is a published run, without the state to go on from; begin a new one")
            if (folder / "policy.pt").exists() and not (folder / "checkpoint.pt").exists():
                raise BadInput(f"{name}: {folder} has lost its checkpoint.pt; begin a new one")
            self._made = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = open(folder / "lock", "w")  # noqa: SIM115 - held until close
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise BadInput(f"{name}: another process is running {folder}") from None
        except OSError as error:
            raise BadInput(f"--data_dir {folder.parent}: cannot write {folder} ({error.strerror})") from None
        self.checkpoint = None
        try:
            if (folder / "checkpoint.pt").exists():
                self.checkpoint = load_torch(folder / "checkpoint.pt")
                self._same_run()
                self._log = json.loads(self.checkpoint["log"])
                for table in self.columns:
                    path, size = folder / f"{table}.csv", self.checkpoint["log_bytes"][table]
                    if not path.exists() or path.stat().st_size < size:
                        raise BadInput(f"{path} is gone or shorter than its checkpoint says ({size} bytes)")
                if "policy" in self.checkpoint:  # in case it was killed between the two
                    self._store("policy.pt", self.checkpoint["policy"])
        except BadInput as error:
            self._lock.close()
            raise BadInput(f"--resume: {error}") from None

    def _same_run(self):
        """A checkpoint continues a run of the same flags only, but for length and noise; flags it lacks: by default."""
        saved, path, now = self.checkpoint, self.folder / "checkpoint.pt", self._config
        parts = {"format", "config", "log", "log_bytes", "seconds"}
        if not isinstance(saved, dict) or not parts <= set(saved) or saved["format"] != FORMAT:
            raise BadInput(f"{path}: of another version of this code; begin a new --name")
        before = {field.name: field.default for field in dataclasses.fields(self.flags)} | json.loads(saved["config"])
        if before["algo"] != now["algo"]:
            raise BadInput(f"{path}: a run of {before['algo']}, not of {now['algo']}")
        for key in sorted(set(now) | set(before)):
            if key not in FREE and now.get(key) != before.get(key):
                raise BadInput(f"{path}: made with --{key} {before.get(key)}, not {now.get(key)}")
        path = self.folder / "config.json"
        try:
            self._recorded = json.loads(path.read_text())
            self._recorded["versions"], int(self._recorded["epochs"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise BadInput(f"{path}: a run's settings as JSON are expected ({one_line(error)})") from None

    def __enter__(self):
        main = threading.current_thread() is threading.main_thread()  # elsewhere Python has no signals
        self._handlers = {n: signal.signal(n, self._asked_to_stop) for n in STOP_SIGNALS if main}
        return self

    def _asked_to_stop(self, number, frame):
        self.stop_signals.append(number)
        if not self._files:  # nothing has begun that could be saved
            raise KeyboardInterrupt

    def __exit__(self, kind, error, trace):
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        for part in (self._bar, *self._files.values(), self._board):
            if part is not None:
                part.close()
        if not self._files and self._made and not self.checkpoint:  # stopped before anything was written
            with contextlib.suppress(OSError):
                (self.folder / "lock").unlink()
                self.folder.rmdir()
        self._lock.close()

    def finished(self):
        """Whether the checkpoint is of a run's end; says so."""
        done = bool(self.checkpoint) and self.checkpoint["t"] >= self.total_steps
        if done:
            print(f"{self.folder}: finished, {self.checkpoint['t']} steps; more with --resume {self.folder} --epochs N")
        return done

    def begin(self, demo_env_steps=0):
        """Writes config.json, opens the curves, cut back to the checkpoint, and says what comes."""
        start = self.checkpoint["t"] if self.checkpoint else 0
        if not self.checkpoint:
            self._log["demo_env_steps"] = demo_env_steps
            if self.flags.resume and not self.flags.quiet:
                print(f"{self.folder}: no checkpoint there, so this begins a new run")
        with self._or_say_so():
            for table, columns in self.columns.items():
                path = self.folder / f"{table}.csv"
                if self.checkpoint:
                    os.truncate(path, self.checkpoint["log_bytes"][table])  # rows after the checkpoint are made again
                else:
                    path.write_text(",".join(columns) + "\n")
                self._files[table] = open(path, "a", newline="", buffering=1)  # noqa: SIM115
            for path in [*self.folder.glob("evaluation*.csv"), *self.folder.glob("trajectories.npz")]:
                if "-steps_" not in path.name:  # a test study of the policy so far, which now learns on
                    path.rename(path.with_stem(f"{path.stem}-steps_{start}"))
            self._write_config()
        self._seconds = self.checkpoint["seconds"] if self.checkpoint else 0.0
        self._since = time.monotonic()
        if self.flags.tensorboard:
            from torch.utils.tensorboard import SummaryWriter
            from torch.utils.tensorboard.summary import hparams

            self._board = SummaryWriter(self.folder, purge_step=start + 1)
            plain = {k: v if isinstance(v, (int, float, str)) else str(v) for k, v in self._config.items()}
            for part in hparams(plain, {"test/eval_success": 0, "train/EpRet": 0}):
                self._board.file_writer.add_summary(part)
        self._bar = tqdm(total=self.total_steps, initial=start, unit="step", smoothing=0.02, mininterval=1,
                         disable=self.flags.quiet or None)  # fmt: skip
        self._shown = ["eval_success", "epoch", "env_steps", "EpRet", "Success", "EpLen"]
        self._shown += [c for c in self.columns["progress"][len(PROGRESS) : -2] if c not in ("L_O", "L_C", "L_A")]
        self._say(f"{self.folder}: {self.total_steps:,} steps, {self._log['demo_env_steps']:,} of the demonstrator")
        heads = {"eval_success": "valid %", "Success": "train %", "env_steps": "steps"}
        self._say(" ".join(f"{heads.get(c, c):>{max(7, len(c))}}" for c in self._shown))

    def _say(self, text):
        if not self.flags.quiet:
            self._bar.write(text)

    def _write_config(self):
        """config.json: the flags, the command and the versions; those of a resume too, where they are others."""
        made_with = versions()
        text = self._config | {"command": sys.argv, "versions": made_with}
        if self.checkpoint:
            before = self._recorded
            text = (text if self._config["epochs"] > before["epochs"] else before) | {"versions": before["versions"]}
            resumed = before.get("resumed_with", [])
            if made_with != [before["versions"], *resumed][-1]:
                resumed = [*resumed, made_with]
            text |= {"resumed_with": resumed} if resumed else {}
        atomic_write(self.folder / "config.json", json.dumps(text, indent=1, default=str))

    @contextlib.contextmanager
    def _or_say_so(self):
        """Around what writes: a full disk ends the run with 2 and one line; what was saved before stays as it is."""
        try:
            yield
        except (OSError, RuntimeError) as error:  # torch.save turns the one into the other
            for file in self._files.values():  # their buffers would be written once more, and fail once more
                with contextlib.suppress(OSError):
                    file.close()
            raise BadInput(f"--data_dir {self.folder.parent}: cannot write {self.folder} ({one_line(error)}); "
                           "go on from its last checkpoint with --resume") from None  # fmt: skip

    def _write(self, table, row):
        """Appends a row (dict by column; None and NaN are left blank)."""
        values = [row.get(column) for column in self.columns[table]]
        texts = ["" if v is None or v != v else f"{v:.9g}" if isinstance(v, float) else v for v in values]
        with self._or_say_so():
            csv.writer(self._files[table], lineterminator="\n").writerow(texts)

    def log_episode(self, env_steps, info):
        """One line of episodes.csv. env_steps: after it; info: of its last step."""
        self._log["episodes"] += 1
        episode = info["episode"]
        self._write("episodes", {
            "episode": self._log["episodes"], "env_steps": env_steps, "return": episode["r"], "length": episode["l"],
            "success": int(info["is_success"]), "collision": info["collision"],
        })  # fmt: skip
        self._log["epoch_episodes"].append([episode["r"], episode["l"], int(info["is_success"])])
        self._bar.update(env_steps - self._bar.n)

    def log_updates(self, measured, net):
        """Floats by name (NaN: not measured) of some updates of net; the epoch's line has their mean. Raises NotFinite
        where a weight is not finite: nothing may act with it, or overwrite a checkpoint."""
        if not all(w.isfinite().all() for w in net.parameters()):
            raise NotFinite(f"{self.folder}: a weight is NaN or infinite; begin anew with smaller learning rates")
        self._log["epoch_updates"].append(measured)

    def log_epoch(self, env_steps, evaluate):
        """One line of progress.csv and of the table. evaluate(): {"eval_success", "eval_return"}, where it is due."""
        last, epoch = env_steps == self.total_steps, env_steps // self.flags.steps_per_epoch
        due = self.flags.eval_every and (last or epoch % self.flags.eval_every == 0)
        row = {"epoch": epoch, "env_steps": env_steps,
               "demo_env_steps": self._log["demo_env_steps"], "seconds": self.seconds()}  # fmt: skip
        if episodes := self._log["epoch_episodes"]:
            row |= zip(("EpRet", "EpLen", "Success"), np.mean(episodes, axis=0).tolist(), strict=True)
        for name in self._log["epoch_updates"][0] if self._log["epoch_updates"] else ():
            known = [m[name] for m in self._log["epoch_updates"] if not math.isnan(m[name])]
            row[name] = float(np.mean(known)) if known else None
        self._log["epoch_episodes"], self._log["epoch_updates"] = [], []
        row |= evaluate() if due else {}
        self._write("progress", row)
        percent = {name: 100 * row[name] for name in ("eval_success", "Success") if name in row}
        cells = [(row | percent).get(c) for c in self._shown]
        self._say(" ".join(f"{'-' if v is None else f'{v:.4g}' if isinstance(v, float) else v:>{max(7, len(c))}}"
                           for c, v in zip(self._shown, cells, strict=True)))  # fmt: skip
        self._bar.update(env_steps - self._bar.n)
        for column, v in row.items() if self._board else ():
            if v is not None:
                self._board.add_scalar(f"{BOARD.get(column.split('_')[0], 'update')}/{column}", v, env_steps)

    def must_save(self, env_steps):
        """Whether a checkpoint is due, or the run was asked to stop."""
        epoch, of_epoch = divmod(env_steps, self.flags.steps_per_epoch)
        due = of_epoch == 0 and (epoch % self.flags.checkpoint_every == 0 or env_steps == self.total_steps)
        return due or bool(self.stop_signals)

    def stop_if_asked(self, env_steps):
        """After a save: raises KeyboardInterrupt where the run was asked to stop before its end."""
        if self.stop_signals and env_steps < self.total_steps:
            raise KeyboardInterrupt(f"{self.folder}: stopped at step {env_steps}, state saved; go on with --resume")

    def seconds(self):
        """Wall-clock seconds of the run, earlier parts included, the recording of demonstrations not."""
        return self._seconds + time.monotonic() - self._since

    def save(self, state, policy):
        """Writes checkpoint.pt, `state` (tensors and plain types) and what a resume needs of the folder itself, then
        policy.pt (see evaluate.Policy): one that is alone has lost its checkpoint."""
        with self._or_say_so():
            sizes = {}
            for table, file in self._files.items():
                file.flush()
                os.fsync(file.fileno())
                sizes[table] = os.fstat(file.fileno()).st_size
            state = state | {"log_bytes": sizes, "log": json.dumps(self._log), "seconds": self.seconds(),
                             "config": json.dumps(self._config), "format": FORMAT, "policy": policy}  # fmt: skip
        self._store("checkpoint.pt", state)
        self._store("policy.pt", policy)

    def _store(self, name, content):
        import torch

        with self._or_say_so():
            atomic_write(self.folder / name, lambda file: torch.save(content, file))
