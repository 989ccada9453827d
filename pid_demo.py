"""The PID demonstrator (Eq. 5, Sec. 3.2): watch it, measure it, record it.

    python pid_demo.py --task p2p --gif pid.gif     # a film of three episodes
    python pid_demo.py --task p2p --watch           # in PyBullet's window
    python pid_demo.py --task p2p --trials 500 --stage test
    python pid_demo.py --task p2p --record 100 --out demos.npz
    python pid_demo.py --inspect demos.npz          # what a file holds
    python ddpg_demoease.py --recipe robust --demos demos.npz       # trains with it

The controller drives joint angles to the inverse kinematics of Cartesian set
points; the action is the reference joint velocity in the environment's
normalised units. Gains: `authors` are those of the authors' code (280 steps a
demonstration of P2P); with `fast` it takes some 120.
"""

import contextlib
import dataclasses
import json
import math
import os
import warnings
import zipfile
import zlib
from pathlib import Path

import gymnasium
import numpy as np
from tqdm import tqdm

import film
import gas
import kinova_env
import logx
from kinova_env import EPSILON, INDEX, OBS_DIM, STAGES, TASKS, TIME_STEP, grasp_postures, postures, wrap
from logx import flag

# m. obstacle: what the links keep from P2P-O's cube. object: how far before P&P's cube the approach begins, at most
CLEARANCE = {"obstacle": 0.13, "object": 0.15}
ABOVE = 0.18  # m, of P2P-O's cube at which the TCP crosses it
ASIDE = 0.19  # m, from P2P-O's cube to which the arm turns away before it rises
BLEND = 0.1  # m, over which one part of the way over P2P-O's cube becomes the next
PENALTY = 50.0  # rad of way that a metre of missing clearance is worth
FINGERS, WIDER = 0.016, 0.04  # m: they reach beyond the TCP; the gripper reaches further to either side than the arm
NOISE_KEPT = 0.9  # of the noise of one step in the next, 20 ms later
MINARI = "minari:"  # what the name of a Minari dataset begins with
GAINS = {"authors": (0.4, 0.2, 0.0), "fast": (1.0, 0.2, 0.0)}  # K_P (1/rad), K_D (s/rad), K_I (1/(rad s))


def arm(folds):
    """(r, z), each (M, 4) in m, of shoulder, elbow, wrist and finger tips in the arm's own plane.

    folds: (M, 3), the joints that move within that plane: the paper's #2, #3 and #4 (rad).
    """
    tilt = folds[:, :1] - np.cumsum(folds * (0, 1, 1), axis=1)  # of each link, from the vertical
    links = np.array((kinova_env.UPPER_ARM, kinova_env.FOREARM, kinova_env.HAND + FINGERS))
    r, z = (np.cumsum(np.hstack([np.zeros((len(folds), 1)), links * f(tilt)]), axis=1) for f in (np.sin, np.cos))
    return r, z + kinova_env.SHOULDER_HEIGHT


class PID:
    """a_t = K_P q~ + K_I integral(q~) + K_D dq~/dt (Eq. 5), q~ = q_sp - q in rad, for all four joints; dq~/dt is taken
    as -dq/dt, the set point at rest.

    env: a KinovaEnv or a wrapper of one; a new episode is noticed by itself. gains: a name in GAINS or (K_P, K_D, K_I).
    `act()` returns the action (4,) float32 in [-1, 1]. Where K_I > 0, a joint's integral rests while its action is
    saturated (anti-windup). clearance: in m, instead of CLEARANCE.
    """

    def __init__(self, env, gains="authors", clearance=None):
        self.env = env.unwrapped
        self.K_P, self.K_D, self.K_I = GAINS[gains] if isinstance(gains, str) else gains
        self.clearance = CLEARANCE.get(self.env.row.cube) if clearance is None else clearance
        self._episode = None

    def _clearest(self, found, beside):
        """Of postures (M, 4) the one with the least way from the present, plus PENALTY times the `clearance` it lacks
        from the cube, which lies `beside` rad from the arm's plane."""
        q, (x, y, z_o), (r, z) = np.array(self.env.q), self.env.cube, arm(found[:, 1:])
        rho = math.hypot(x, y)
        dr, dz = np.diff(r), np.diff(z)
        to_r, to_z = rho * math.cos(beside) - r[:, :-1], z_o - z[:, :-1]
        t = np.clip((to_r * dr + to_z * dz) / (dr**2 + dz**2), 0, 1)  # the point of each link nearest to the cube
        aside = np.maximum(0, abs(rho * math.sin(beside)) - np.array((0, 0, WIDER)))
        clear = np.sqrt((to_r - t * dr) ** 2 + (to_z - t * dz) ** 2 + aside**2).min(1)
        way = np.hypot(wrap(found[:, 0] - q[0]), np.linalg.norm(found[:, 1:] - q[1:], axis=1))
        return found[np.argmin(way + PENALTY * np.maximum(0, self.clearance - clear))]

    def _over(self):
        """A posture on the way over P2P-O's cube, by midway points (Sec. 3.2): rise above it, cross, descend.

        Beside the cube the arm first turns away from it. A function of the state, not of what was reached before: a
        clone of the demonstrations can follow it, but where the cube lies dead ahead and the side to turn to flips.
        """
        places = (self.env.tcp, self.env.goal, self.env.cube)
        (x, y, z), (x_g, y_g, z_g), (x_o, y_o, z_o) = places
        to_goal, to_cube = math.dist((x, y), (x_g, y_g)), math.dist((x, y), (x_o, y_o))  # horizontally
        apart = math.dist((x_g, y_g), (x_o, y_o))
        azimuth, of_goal, of_cube = (math.atan2(place[1], place[0]) for place in places)
        turn, beside = wrap(of_goal - azimuth), wrap(of_cube - azimuth)

        # 0: stay up, 1: be down. Grows as the TCP comes from 0.2 to 0.1 m of the goal, and gets from 0.55 d to 0.8 d
        # away from the cube; d: from the cube to the goal, 0.16 m at most
        descend = np.clip(min(2 - to_goal / BLEND, (to_cube / np.clip(apart, 1e-6, 0.16) - 0.55) / 0.25), 0, 1)
        height = z_g + max(0, z_o + ABOVE - z_g) * (1 - descend)
        found = postures((x_g, y_g, height))
        passes = 0 < beside * np.sign(turn) < abs(turn)
        nearest = 0 if passes else min(abs(beside), abs(wrap(beside - turn)))  # the arm's least angle to it on the turn
        cross = self._clearest(found if len(found) else postures(self.env.goal), nearest)

        close = np.clip((ASIDE - 0.01 - to_cube) / 0.05, 0, 1)  # 1: turns away only; 0: rises only
        away = max(0, math.asin(min(1, ASIDE / math.hypot(x_o, y_o))) - abs(beside)) * (close > 0)
        rise = z + (height - z) * (1 - close)
        found = postures(kinova_env.cartesian(azimuth - math.copysign(away, beside), math.hypot(x, y), rise))
        below = np.clip((height - z) / BLEND, 0, 1)
        if not below or not len(found):
            return cross
        way = self._clearest(found, beside) - cross
        way[0] = wrap(way[0])
        return cross + below * way

    def _approach(self):
        """Postures that grasp on the horizontal line from the base's axis through the cube: at the point EPSILON behind
        the cube, drawn back by the TCP's distance from that line. Aiming past the cube, the arm does not slow down
        where the grasp comes within reach.

        A function of the state, not of what was reached before: a clone of the demonstrations can follow it.
        """
        (x, y, z), (x_e, y_e, z_e) = self.env.cube, self.env.tcp
        rho = math.hypot(x, y)
        ahead = x_e * x + y_e * y > 0  # else the arm has yet to turn round
        beside = math.hypot((x_e * y - y_e * x) / rho, z_e - z) if ahead else math.inf
        for back in np.linspace(min(self.clearance, beside - EPSILON, 0.9 * rho), 0, 6):  # out of reach: less far back
            found = grasp_postures(((1 - back / rho) * x, (1 - back / rho) * y, z))
            if len(found):
                return found

    def _nearest(self, found):
        """Of postures (M, 4), M > 0, the one nearest to the present."""
        q = np.array(self.env.q)
        return found[np.argmin(wrap(found[:, 0] - q[0]) ** 2 + np.sum((found[:, 1:] - q[1:]) ** 2, axis=1))]

    def act(self):
        """The action (4,) float32 for the environment's present state."""
        if self._episode != self.env.episode:
            self._episode, self._goal, self._integral = self.env.episode, None, np.zeros(4)
        if self.env.row.cube == "obstacle":
            self._q_sp = self._over()
        elif self.env.row.cube == "object" and not self.env.grasped:
            self._q_sp = self._nearest(self._approach())
        elif self._goal is None:
            self._q_sp = self._goal = self._nearest(postures(self.env.goal))
            self._integral = np.zeros(4)
        q_tilde = self._q_sp - self.env.q
        q_tilde[0] = wrap(q_tilde[0])  # joint 1 turns without end: the shortest way round
        integral = self._integral + q_tilde * TIME_STEP
        a = self.K_P * q_tilde + self.K_I * integral - self.K_D * np.asarray(self.env.q_dot)
        self._integral = np.where(np.abs(a) < 1, integral, self._integral)
        return np.clip(a, -1, 1).astype(np.float32)


# A demonstration file: one entry a step, one entry an episode.
ROWS = dict(obs="f4", act="f4", rew="f8", obs2="f4", terminated="?", truncated="?", episode="i8", executed="f4")
EPISODES = {"partition": "i8", "success": "?", "length": "i8", "return": "f8", "effort": "f8"}


def record(task, num_demos, gains="authors", seed=0, partitions=4, symmetry="none", stage="demo", quiet=True, noise=0.0,
           clearance=None):  # fmt: skip
    """Demonstration episodes (Sec. 3.2), failed ones included. clearance: the PID's, in m.

    noise: standard deviation of noise on the actions, correlated over some 0.2 s (ours, after Laskey et al., DART,
    2017): states beside the demonstrator's path, with the action that leads back to it. `act` holds what the controller
    asked for, and `executed` (there only with noise) what was done.

    symmetry "gas": ceil(num_demos / partitions) real episodes in partition 0, each mapped to the others, the surplus
    dropped; any other: num_demos real episodes in uniformly drawn partitions. Returns (demos, env_steps): the arrays of
    a demonstration file (data/README.md), and how many steps of the environment they took.
    """
    env = gymnasium.make(TASKS[task].env_id, stage=stage, partitions=partitions, disable_env_checker=True)
    pid, rng = PID(env, gains, clearance), np.random.default_rng((seed, 1))
    demos = {name: [] for name in ROWS | EPISODES}
    real = -(-num_demos // partitions) if symmetry == "gas" else num_demos
    env.reset(seed=seed)
    for n in tqdm(range(real), desc="demonstrations", unit="episode", disable=quiet or None):
        s, info = env.reset(options={"partition": 0} if symmetry == "gas" else None)
        rewards, efforts, terminated, truncated = [], [], False, False
        drift = np.zeros(4)
        while not (terminated or truncated):
            a = executed = pid.act()
            if noise:
                drift = NOISE_KEPT * drift + math.sqrt(1 - NOISE_KEPT**2) * noise * rng.standard_normal(4)
                executed = np.clip(a + drift, -1, 1).astype(np.float32)
            s2, r, terminated, truncated, info = env.step(executed)
            for name, value in zip(ROWS, (s, a, r, s2, terminated, truncated, n, executed), strict=True):
                demos[name].append(value)
            s = s2
            rewards.append(r)
            efforts.append(50 * info["effort"])  # T_eff, Eq. 12: percent of its largest possible value, 2
        of_episode = info.get("partition", -1), info["is_success"], len(rewards), sum(rewards), np.mean(efforts)
        for name, value in zip(EPISODES, of_episode, strict=True):
            demos[name].append(value)
    env.close()
    demos = {name: np.array(demos[name], dtype=dtype) for name, dtype in (ROWS | EPISODES).items()}
    if not noise:
        del demos["executed"]
    steps = len(demos["rew"])
    return (gas.aggregate(demos, partitions, num_demos) if symmetry == "gas" else demos), steps


def load_demos(path, task=None):
    """The arrays of a demonstration file, or of a Minari dataset `minari:NAME`, and its `meta`; task: what it must be
    of. Raises ValueError with what is wrong with it."""
    kind = "a Minari dataset of our tasks" if str(path).startswith(MINARI) else "a demonstration file of --record"
    try:
        demos, meta = (read_minari if str(path).startswith(MINARI) else read_file)(path)
        if meta["task"] not in TASKS:
            raise ValueError(f"its task is {logx.one_line(meta['task'])}")
        if not len(demos["length"]):
            raise ValueError("it has no episode")
        demos = {name: column for name, column in demos.items() if name in ROWS | EPISODES}
        if missing := (ROWS | EPISODES).keys() - {"executed", "effort"} - demos.keys():
            raise ValueError(f"it lacks {', '.join(sorted(missing))}")
        rows, episodes, width = demos["length"].sum(), len(demos["length"]), OBS_DIM[meta["task"]]
        columns = {"obs": (width,), "obs2": (width,), "act": (4,), "executed": (4,)}
        for name, dtype in ((name, dtype) for name, dtype in (ROWS | EPISODES).items() if name in demos):
            shape = (rows if name in ROWS else episodes, *columns.get(name, ()))
            if demos[name].shape != shape:
                raise ValueError(f"its {name} is {demos[name].shape}, {shape} is expected")
            if not np.all(np.isfinite(demos[name])):
                raise ValueError(f"nan or inf in its {name}")
            if name in ("act", "executed") and np.abs(demos[name]).max(initial=0) > 1:
                raise ValueError(f"its {name} leaves [-1, 1]")
            demos[name] = demos[name].astype(dtype)
        if not np.array_equal(demos["episode"], np.repeat(np.arange(episodes), demos["length"])):
            raise ValueError("its episode does not count from 0 as its length says")
        ends = np.flatnonzero(demos["terminated"] | demos["truncated"])
        if not np.array_equal(ends, np.cumsum(demos["length"]) - 1):
            raise ValueError("an episode ends, terminated or truncated, at another step than its last")
        for name in ("obs", "obs2"):
            q, sine = (demos[name][:, INDEX[meta["task"]][part]] for part in ("q", "sin q"))
            if np.abs(np.sin(q) - sine).max() > 1e-3:
                raise ValueError(f"its {name} has other sines than those of its angles, in rad")
        if [type(meta[key]) for key in ("env_steps", "partitions", "symmetry")] != [int, int, str]:
            raise ValueError("its meta lacks env_steps, partitions or symmetry")
        if np.any(demos["partition"] >= meta["partitions"]):
            raise ValueError(f"it has a partition above {meta['partitions'] - 1}")
    except ImportError:
        raise ValueError(f"{path}: needs pip install -e '.[minari]'") from None
    except FileNotFoundError:
        raise ValueError(f"{path}: no such {'dataset' if 'Minari' in kind else 'file'}") from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, EOFError, zipfile.BadZipFile,
            zlib.error) as error:  # fmt: skip
        raise ValueError(f"{path}: not {kind} ({'it lacks ' * isinstance(error, KeyError)}{error})") from None
    if task not in (None, meta["task"]):
        raise ValueError(f"{path}: recorded on task {meta['task']}, not {task}")
    return demos, meta


def open_npz(path):
    """numpy.load of arrays only. Raises ValueError where it is no .npz: numpy would advise to trust the file."""
    if os.path.isfile(path) and not zipfile.is_zipfile(path):
        raise ValueError("it is no .npz, or one cut short")
    return np.load(path, allow_pickle=False)


def read_file(path):
    with open_npz(path) as file:
        demos = {name: file[name] for name in file.files}
    return demos, json.loads(str(demos.pop("meta")))


def read_minari(path):
    """A Minari dataset of one of our environments, recorded here or by others: those may lack what is an episode's."""
    import minari

    dataset = minari.load_dataset(path.removeprefix(MINARI))
    tasks = {row.env_id: task for task, row in TASKS.items()}
    meta = {"task": tasks[dataset.env_spec.id], "env_steps": int(dataset.total_steps), "partitions": 4}
    about, infos = dataset.storage.metadata.get("demonstrations"), {}
    meta |= {"symmetry": "none"} | json.loads(about or "{}")
    demos = {name: [] for name in ROWS | EPISODES}
    for n, found in enumerate(dataset.iterate_episodes()):
        infos, length = found.infos if about else {}, len(found.rewards)  # others' are the environment's, a step each
        rows = (found.observations[:-1], infos.get("asked", found.actions), found.rewards, found.observations[1:],
                found.terminations, found.truncations, np.full(length, n), found.actions)  # fmt: skip
        of_episode = {"partition": gas.partition_of(found.observations[0], meta["partitions"]), "effort": np.nan}
        of_episode |= {"success": found.rewards[-1] > kinova_env.R_1 / 2} | {
            k: infos[k][0] for k in EPISODES if k in infos
        }
        for name, value in zip(ROWS, rows, strict=True):
            demos[name].extend(value)
        for name, value in (of_episode | {"length": length, "return": sum(found.rewards.tolist())}).items():
            demos[name].append(value)
    demos = {name: np.array(demos[name], dtype=dtype) for name, dtype in (ROWS | EPISODES).items()}
    for name in ["executed"] * ("asked" not in infos) + ["effort"] * ("effort" not in infos):
        del demos[name]
    return demos, meta


def write_minari(name, demos, meta):
    """The episodes as a Minari dataset, where Minari keeps them (MINARI_DATASETS_PATH). Its actions are what was done;
    what was asked for, where that is another thing, and what a demonstration file has an episode are its infos."""
    import minari
    from minari.data_collector import EpisodeBuffer

    episodes, end = [], 0
    for n, length in enumerate(demos["length"]):
        of = {key: demos[key][end : end + length] for key in ROWS if key in demos}
        infos = {key: np.repeat(demos[key][n], length) for key in ("partition", "success", "effort")}
        infos |= {"asked": of["act"]} if "executed" in of else {}
        episodes.append(EpisodeBuffer(
            observations=np.concatenate((of["obs"], of["obs2"][-1:])), actions=of.get("executed", of["act"]),
            rewards=of["rew"], terminations=of["terminated"], truncations=of["truncated"], infos=infos))  # fmt: skip
        end += length
    spec = gymnasium.spec(TASKS[meta["task"]].env_id)
    about = dict(algorithm_name="PID", description="Demo-EASE: demonstrations of a PID controller on a Kinova Gen3")
    with warnings.catch_warnings(action="ignore"):  # that no author is named
        dataset = minari.create_dataset_from_buffers(name, episodes, env=spec, **about)
    dataset.storage.update_metadata({"demonstrations": json.dumps(meta)})


def given(path, task, symmetry, partitions):
    """(all that --demos gives under --symmetry, its meta). Raises BadInput that names the flag."""
    try:
        demos, meta = load_demos(path, task)
    except ValueError as error:
        raise logx.BadInput(f"--demos {error}") from None
    if meta["partitions"] != partitions:
        raise logx.BadInput(f"--demos {path}: of {meta['partitions']} partitions, not --partitions {partitions}")
    if symmetry == "gas" and meta["symmetry"] != "gas":
        demos = gas.aggregate(demos, partitions)
    if not len(demos["length"]):
        others = ", ".join(name for name in gas.SYMMETRIES if name != "gas")
        raise logx.BadInput(f"--demos {path}: has no episode of partition 0, which --symmetry gas maps to the others; "
                            f"allowed: --symmetry {others}")  # fmt: skip
    return demos, meta


def all_of(flags, recipe):
    """How many episodes --demos gives under flags.symmetry, where that is None the recipe's. Raises BadInput."""
    demos, _ = given(flags.demos, flags.task, flags.symmetry or recipe["symmetry"], flags.partitions)
    return len(demos["length"])


def demonstrations(flags):
    """(arrays of N_demos episodes, real environment steps they took; of a file, all that it took): those of
    flags.demos, else recorded.

    flags: as of the algorithm scripts. (None, 0) for no demonstrations. Raises BadInput that names the flag.
    """
    if not flags.num_demos:
        return None, 0
    if flags.demos is None:
        settings = dict(gains=flags.gains, seed=flags.seed, partitions=flags.partitions, symmetry=flags.symmetry)
        try:
            return record(flags.task, flags.num_demos, **settings, noise=flags.demo_noise, quiet=flags.quiet)
        except ValueError as error:
            raise logx.BadInput(f"--{error}") from None
    demos, meta = given(flags.demos, flags.task, flags.symmetry, flags.partitions)
    found = len(demos["length"])
    if found < flags.num_demos:
        raise logx.BadInput(f"--demos {flags.demos}: gives {found} episodes, fewer than --num_demos {flags.num_demos}")
    return {name: demos[name][demos["episode"] < flags.num_demos] for name in ROWS if name in demos}, meta["env_steps"]


def check_used(flags, defaults):
    """Raises BadInput where flags of an algorithm script that need demonstrations are other than its recipe's
    `defaults`, and there are none."""
    of_demos = "clone_iters keep_clone demo_noise normalize_obs mask demos_per_epoch partitions"
    for name in of_demos.split() if flags.num_demos == 0 else ():
        if getattr(flags, name, 0) not in (0, defaults.get(name, getattr(type(flags), name, 0))):
            raise logx.BadInput(f"--{name}: is of demonstrations, and --num_demos 0 has none")


def inspect(path):
    """Prints what a demonstration file holds, by partition. Raises BadInput."""
    try:
        demos, meta = load_demos(path)
    except ValueError as error:
        raise logx.BadInput(f"--inspect {error}") from None
    settings = ", ".join(f"{'K_P K_D K_I' if key == 'gains' else key} {value}"
                         for key, value in meta.items() if key not in ("task", "env_steps"))  # fmt: skip
    print(f"{path}: {meta['task']}, recorded in {meta['env_steps']:,} steps of the environment; {settings}")
    print("partition  episodes  success %  steps, median [least, most]   return     |a|")
    for k in [*np.unique(demos["partition"]), "all"]:
        of = demos["partition"] == k if k != "all" else np.full(len(demos["partition"]), True)
        length, done = demos["length"][of], demos.get("executed", demos["act"])
        a = done[np.isin(demos["episode"], np.flatnonzero(of))]
        steps = f"{np.median(length):.0f} [{length.min()}, {length.max()}]"
        print(f"{k!s:>9}  {of.sum():>8}  {100 * demos['success'][of].mean():>9.1f}  {steps:>27}  "
              f"{demos['return'][of].mean():>7.2f}  {np.abs(a).mean():>6.3f}")  # fmt: skip


@dataclasses.dataclass
class Flags:
    task: str = flag("p2p", choices=tuple(TASKS))
    # one of
    record: int | None = flag(None, "record N episodes into --out", low=1, high=1_000_000, metavar="N")
    trials: int | None = flag(
        None, "run N episodes and print mean success, length, ...", low=1, high=1_000_000, metavar="N"
    )
    watch: bool = flag(False, "three episodes in PyBullet's window")
    gif: Path | None = flag(None, "three episodes into a GIF, or an MP4 (pip install -e '.[video]')", metavar="FILE")
    inspect: str | None = flag(None, "print what a demonstration file, or minari:NAME, holds", metavar="FILE")

    out: Path | None = flag(None, "the .npz of --record", metavar="FILE")
    minari: str | None = flag(None, "the Minari dataset of --record, as kinova/p2p/fast-v0; pip install -e '.[minari]'",
                              metavar="NAME")  # fmt: skip
    gains: str = flag("authors", choices=tuple(GAINS))
    K_P: float | None = flag(None, "instead of that of --gains", low=0)
    K_D: float | None = flag(None, "instead of that of --gains", low=0)
    K_I: float | None = flag(None, "instead of that of --gains", low=0)
    clearance: float | None = flag(
        None,
        "from the cube, in m: p2po, of the links ({obstacle}); pnp, of where the approach begins ({object})".format(
            **CLEARANCE
        ),
        low=0,
        high=0.5,
        metavar="M",
    )
    noise: float = flag(0.0, "standard deviation of noise on the actions of --record, --trials", low=0, high=10)
    stage: str = flag("demo", choices=STAGES)
    symmetry: str = flag("none", "gas: record one partition, map it to the others", choices=("none", "gas"))
    partitions: int = flag(4, "K", low=1, high=100, metavar="K")
    seed: int = flag(0, low=0)


def refuse_useless(flags, *rules):
    """Raises BadInput for a flag that was given and would do nothing, by rules (whether it holds, flags, what they do
    not go with); of evaluate.py too."""
    fields = sorted(dataclasses.fields(flags), key=lambda field: field.name)
    for there, useless, where in rules:
        for field in fields if there else ():
            if field.name in useless and getattr(flags, field.name) != field.default:
                name = field.metadata["metavar"] if field.metadata["positional"] else f"--{field.name}"
                raise logx.BadInput(f"{name}: does not go with {where}")


def check(flags):
    """Raises BadInput where flags do not fit together or a file cannot be written."""
    asked = ("record", "trials", "watch", "gif", "inspect")
    jobs = [f"--{name}" for name in asked if getattr(flags, name)]
    if len(jobs) != 1:
        raise logx.BadInput(f"--{', --'.join(asked)}: one of them is expected" + f", not {' '.join(jobs)}" * bool(jobs))
    (job,) = jobs
    refuse_useless(
        flags,
        (flags.inspect, set(vars(flags)) - {"inspect"}, job),
        (flags.watch or flags.gif, {"noise", "symmetry"}, job),
        (flags.trials, {"symmetry"}, job),
        (not TASKS[flags.task].cube, {"clearance"}, f"--task {flags.task}"),
        (flags.stage != "demo", {"symmetry", "partitions"}, f"--stage {flags.stage}"),
    )
    film.check(flags.gif, flags.watch)
    if bool(flags.record) != bool(flags.out or flags.minari):
        raise logx.BadInput("--record, --out or --minari: --record needs one of the others, and they need it")
    if flags.minari:
        check_minari(flags.minari)
    if flags.out and (flags.out.is_dir() or not flags.out.absolute().parent.is_dir()):
        raise logx.BadInput(f"--out {flags.out}: must be a file in a folder")


def check_minari(name):
    """Raises BadInput where no Minari dataset can get this name, before anything is recorded for it."""
    try:
        import minari
        from minari.dataset.minari_dataset import parse_dataset_id

        parse_dataset_id(name)
        taken = name in minari.list_local_datasets()
    except ImportError:
        raise logx.BadInput(f"--minari {name}: needs pip install -e '.[minari]'") from None
    except (gymnasium.error.Error, TypeError):  # the latter without a version
        raise logx.BadInput(f"--minari {name}: must be a Minari name, as kinova/p2p/fast-v0") from None
    except OSError as error:
        raise logx.BadInput(f"--minari {name}: {error.filename} cannot be read ({error.strerror})") from None
    if taken:
        raise logx.BadInput(f"--minari {name}: there is one already; minari delete {name} removes it")


@contextlib.contextmanager
def writing(what):
    """Around what writes files, and prints nothing: raises BadInput that names `what` where it cannot."""
    try:
        yield
    except OSError as error:
        raise logx.BadInput(f"{what}: cannot be written ({error.strerror or error})") from None


def show(flags, gains):
    """Three episodes in PyBullet's window, or as a GIF."""
    settings = dict(stage=flags.stage, partitions=flags.partitions, width=480, height=360)
    env = gymnasium.make(TASKS[flags.task].env_id, render_mode="rgb_array" if flags.gif else "human", **settings)
    pid, seeds = PID(env, gains, flags.clearance), range(flags.seed, flags.seed + 3)
    if flags.gif:
        with writing(f"--gif {flags.gif}"):
            film.film({"PID": (env, lambda s: pid.act())}, flags.gif, {f"episode {seed}": seed for seed in seeds})
        print(f"wrote {flags.gif}")
    for seed in () if flags.gif else seeds:
        env.reset(seed=seed)
        while not any(env.step(pid.act())[2:4]):
            pass
    env.close()


def main():
    flags = logx.parse_flags(Flags, __doc__)
    check(flags)
    own = (flags.K_P, flags.K_D, flags.K_I)
    gains = [named if given is None else given for given, named in zip(own, GAINS[flags.gains], strict=True)]
    settings = dict(gains=gains, seed=flags.seed, partitions=flags.partitions, symmetry=flags.symmetry)
    settings |= dict(noise=flags.noise, clearance=flags.clearance)
    if flags.inspect:
        return inspect(flags.inspect)
    try:
        if flags.watch or flags.gif:
            return show(flags, gains)
        demos, steps = record(flags.task, flags.record or flags.trials, **settings, stage=flags.stage, quiet=False)
    except logx.BadInput:
        raise
    except ValueError as error:  # sectors too narrow
        raise logx.BadInput(f"--{error}") from None
    meta = dict(task=flags.task, stage=flags.stage, env_steps=steps, **settings)
    if flags.minari:
        with writing(f"--minari {flags.minari}"):
            write_minari(flags.minari, demos, meta)
    if flags.out:
        packed = dict(demos, meta=np.array(json.dumps(meta)))
        with writing(f"--out {flags.out}"):
            logx.atomic_write(flags.out, lambda file: np.savez_compressed(file, **packed))
    won = demos["success"]
    length = f"{demos['length'][won].mean():.0f} steps" if won.any() else "no success"
    print(
        f"{flags.task} {flags.stage}, K_P K_D K_I = {gains}: {len(won)} episodes, {steps} environment steps\n"
        f"success {100 * won.mean():.1f} %, length of the successful {length}, return {demos['return'].mean():.2f}, "
        f"effort {demos['effort'].mean():.1f} %, mean |a| {np.abs(demos.get('executed', demos['act'])).mean():.3f}"
    )
    if flags.record:
        print(f"wrote {' and '.join(str(place) for place in (flags.out, flags.minari) if place)}")


if __name__ == "__main__":
    logx.run_script(main)
