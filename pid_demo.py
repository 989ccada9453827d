"""The PID demonstrator (`eq:pid`, `sec:demo`): watch it, measure it, record its episodes.

    python pid_demo.py --task p2p --gif pid.gif                     # a few episodes as a GIF, no display needed
    python pid_demo.py --task p2p --watch                           # the same in PyBullet's window
    python pid_demo.py --task p2p --trials 500 --stage test         # success, length, return, effort
    python pid_demo.py --task p2p --record 100 --out demos.npz      # episodes for ddpg_demoease.py --demos demos.npz

The controller drives joint angles to the inverse kinematics of Cartesian set points; the action is the reference joint
velocity in the environment's normalised units. Gains: `authors` is the slow controller as seen of the authors (about
280 steps on P2P), `fast` reaches in under half the time (see the README for both, measured).
"""

import argparse
import json
import math
import os
import zipfile
import zlib
from pathlib import Path

import gymnasium
import numpy as np
from tqdm import tqdm

import gas
import logx
from kinova_env import EPSILON, OBSERVATION, STAGES, TASKS, TIME_STEP, grasp_postures, postures, wrap

CLEARANCE = {"obstacle": 0.18, "object": 0.15}  # m, of the way above the cube on P2P-O, before it (at most) on P&P
RETRACT = 0.3  # m, radius to which it draws back before it rises beside a cube on P2P-O
RADIUS = 0.1  # m, over which one part of the way over P2P-O's cube becomes the next
NOISE_KEPT = 0.9  # of the noise of one step in the next, 20 ms later
GAINS = {"authors": (0.4, 0.2, 0.0), "fast": (1.0, 0.2, 0.0)}  # K_P (1/rad), K_D (s/rad), K_I (1/(rad s))


class PID:
    """a_t = K_P q~ + K_I integral(q~) + K_D dq~/dt (`eq:pid`), q~ = q_sp - q in rad, for all four joints; dq~/dt is
    taken as -dq/dt, the set point at rest.

    env: a KinovaEnv or a wrapper of one; a new episode is noticed by itself. gains: a name in GAINS or (K_P, K_D, K_I).
    `act()` returns the action (4,) float32 in [-1, 1]. Where K_I > 0, a joint's integral rests while its action is
    saturated (anti-windup). clearance, radius, retract: of the way points, in m.
    """

    def __init__(self, env, gains="authors", clearance=None, radius=RADIUS, retract=RETRACT):
        self.env = env.unwrapped
        self.K_P, self.K_D, self.K_I = GAINS[gains] if isinstance(gains, str) else gains
        self.clearance = CLEARANCE.get(self.env.row.cube) if clearance is None else clearance
        self.radius, self.retract = radius, retract
        self._episode = None

    def _over(self):
        """A posture on the way over P2P-O's cube (`sec:demo`): rise above it, cross, descend, blended over `radius`;
        first draw back where a rise would meet the cube. A function of the state, not of what was reached before.
        """
        (x, y, z), (x_g, y_g, z_g), (x_o, y_o, z_o) = self.env.tcp, self.env.goal, self.env.cube
        to_go = math.dist((x, y), (x_g, y_g)) / self.radius
        height = z_g + max(0, z_o + self.clearance - z_g) * min(1, max(0, to_go - 1))
        found = postures((x_g, y_g, height))
        cross = self._nearest(found if len(found) else postures(self.env.goal))
        below = min(1, max(0, (height - z) / self.radius))
        close = min(1, max(0, (self.clearance - math.dist((x, y), (x_o, y_o))) / self.radius))
        back = 1 + (self.retract / math.hypot(x, y) - 1) * close
        found = postures((x * back, y * back, z + (height - z) * (1 - close)))
        if not below or not len(found):
            return cross
        way = self._nearest(found) - cross
        way[0] = wrap(way[0])
        return cross + below * way

    def _approach(self):
        """Postures that grasp on the cube's horizontal axis, as far before its point EPSILON behind the cube as the TCP
        is beside the axis: aiming past the cube, the arm does not slow down where the grasp comes within reach.

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
        """Of postures (M, 4) the one nearest to the present."""
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


def record(
    task, num_demos, gains="authors", seed=0, partitions=4, symmetry="none", stage="demo", quiet=True, noise=0.0, **way
):
    """Demonstration episodes (`sec:demo`), failed ones included. way: the PID's clearance, radius and retract, in m.

    noise: standard deviation of noise on the actions, correlated over some 0.2 s (ours, after Laskey et al., DART,
    2017): states beside the demonstrator's path, with the action that leads back to it. `act` holds what the controller
    asked for, and `executed` (there only with noise) what was done.

    symmetry "gas": ceil(num_demos / partitions) real episodes in partition 0, each mapped to the others, the surplus
    dropped; any other: num_demos real episodes in uniformly drawn partitions. Returns (demos, env_steps): the arrays of
    a demonstration file (data/README.md), and how many steps of the environment they took.
    """
    env = gymnasium.make(TASKS[task].env_id, stage=stage, partitions=partitions, disable_env_checker=True)
    pid, rng = PID(env, gains, **way), np.random.default_rng((seed, 1))
    rows = {name: [] for name in ("obs", "act", "rew", "obs2", "terminated", "truncated", "episode", "executed")}
    episodes = {name: [] for name in ("partition", "success", "length", "return", "effort")}
    real = -(-num_demos // partitions) if symmetry == "gas" else num_demos
    env.reset(seed=seed)
    for n in tqdm(range(real), desc="demonstrations", unit="episode", disable=quiet):
        s, info = env.reset(options={"partition": 0} if symmetry == "gas" else None)
        total, effort, length, terminated, truncated = 0.0, 0.0, 0, False, False
        drift = np.zeros(4)
        while not (terminated or truncated):
            a = executed = pid.act()
            if noise:
                drift = NOISE_KEPT * drift + math.sqrt(1 - NOISE_KEPT**2) * noise * rng.standard_normal(4)
                executed = np.clip(a + drift, -1, 1).astype(np.float32)
            s2, r, terminated, truncated, info = env.step(executed)
            for column, value in zip(rows.values(), (s, a, r, s2, terminated, truncated, n, executed), strict=True):
                column.append(value)
            s, total, effort, length = s2, total + r, effort + info["effort"], length + 1
        of_episode = (info.get("partition", -1), info["is_success"], length, total, 50 * effort / length)
        for column, value in zip(episodes.values(), of_episode, strict=True):
            column.append(value)
    width = env.observation_space.shape[0]
    env.close()
    dtypes = dict(obs="f4", act="f4", rew="f8", obs2="f4", terminated="?", truncated="?", episode="i8", executed="f4")
    dtypes |= {"partition": "i8", "success": "?", "length": "i8", "return": "f8", "effort": "f8"}
    demos = {name: np.array(column, dtype=dtypes[name]) for name, column in (rows | episodes).items()}
    for name, columns in (("obs", width), ("obs2", width), ("act", 4), ("executed", 4)):
        demos[name] = demos[name].reshape(-1, columns)  # also where there is no row
    if not noise:
        del demos["executed"]
    steps = len(demos["rew"])
    return (gas.aggregate(demos, partitions, num_demos) if symmetry == "gas" else demos), steps


def load_demos(path, task):
    """The arrays of a demonstration file and its `meta`. Raises ValueError with what is wrong with the file."""
    try:
        if os.path.isfile(path) and not zipfile.is_zipfile(path):
            raise ValueError("it is no .npz, or one cut short")
        with np.load(path, allow_pickle=False) as file:
            demos = {name: file[name] for name in file.files}
        meta = json.loads(str(demos.pop("meta")))
        rows, episodes = demos["length"].sum(), len(demos["length"])
        width = sum(width for _, width, _ in OBSERVATION[meta["task"]])
        shapes = {"obs": (rows, width), "obs2": (rows, width), "act": (rows, 4)}
        shapes |= dict.fromkeys(("rew", "terminated", "truncated", "episode"), (rows,))
        shapes |= dict.fromkeys(("partition", "success", "length", "return"), (episodes,))
        shapes |= {"executed": (rows, 4)} if "executed" in demos else {}
        if [type(meta[key]) for key in ("env_steps", "partitions", "symmetry")] != [int, int, str]:
            raise ValueError("its meta lacks env_steps, partitions or symmetry")
        for name, shape in shapes.items():
            if demos[name].shape != shape:
                raise ValueError(f"its {name} is {demos[name].shape}, {shape} is expected")
            if not np.all(np.isfinite(demos[name])):
                raise ValueError(f"nan or inf in its {name}")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file") from None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        lacks = "it lacks " * isinstance(error, KeyError)
        raise ValueError(f"{path}: not a demonstration file of pid_demo.py --record ({lacks}{error})") from None
    if meta["task"] != task:
        raise ValueError(f"{path}: recorded on task {meta['task']}, not {task}")
    return demos, meta


def demonstrations(flags):
    """(arrays of N_demos episodes, real environment steps they took): read from flags.demos, a file, else recorded.

    flags: as of the algorithm scripts. (None, 0) for no demonstrations. Raises ValueError, its text begins with the
    name of the flag that is wrong.
    """
    if not flags.num_demos:
        return None, 0
    if flags.demos is None:
        settings = dict(gains=flags.gains, seed=flags.seed, partitions=flags.partitions, symmetry=flags.symmetry)
        return record(flags.task, flags.num_demos, **settings, noise=flags.demo_noise, quiet=flags.quiet)
    try:
        demos, meta = load_demos(flags.demos, flags.task)
    except ValueError as error:
        raise ValueError(f"demos {error}") from None
    if "gas" in (flags.symmetry, meta["symmetry"]) and meta["partitions"] != flags.partitions:
        found = meta["partitions"]
        raise ValueError(f"demos {flags.demos}: of {found} partitions, not --partitions {flags.partitions}")
    if flags.symmetry == "gas" and meta["symmetry"] != "gas":
        demos = gas.aggregate(demos, flags.partitions)
    found = len(demos["length"])
    if found < flags.num_demos:
        raise ValueError(f"demos {flags.demos}: gives {found} episodes, fewer than --num_demos {flags.num_demos}")
    first = demos["episode"] < flags.num_demos
    columns = {"obs", "act", "executed", "rew", "obs2", "terminated", "truncated", "episode"} & set(demos)
    return {name: demos[name][first] for name in columns}, meta["env_steps"]


def frames(agents, seeds, every):
    """The pictures (height, width, 3) uint8 of episodes, one in `every` steps, the agents' side by side.

    agents: {name: (an env with render_mode "rgb_array", act(obs))}; the names are written on where there are several.
    """
    from PIL import Image, ImageDraw

    for seed in seeds:
        obs = {name: env.reset(seed=seed)[0] for name, (env, _) in agents.items()}
        picture, t = {}, 0
        while obs:  # those that have ended keep their last picture
            for name, (env, act) in agents.items():
                if name in obs and t % every == 0:
                    picture[name] = env.render()
                if name in obs:
                    obs[name], _, terminated, truncated, _ = env.step(act(obs[name]))
                    if terminated or truncated:
                        picture[name] = env.render()
                        del obs[name]
            if t % every == 0 or not obs:
                whole = Image.fromarray(np.concatenate([picture[name] for name in agents], axis=1))
                for n, name in enumerate(agents if len(agents) > 1 else ()):
                    ImageDraw.Draw(whole).text((n * whole.width // len(agents) + 6, 4), name, fill="black")
                yield np.asarray(whole)
            t += 1
        yield from [np.asarray(whole)] * 9  # a rest at the end


def film(agents, path, seeds, every=4):
    """Writes `frames` to a GIF, or to an MP4 (with imageio's ffmpeg) where `path` says so, in real time."""
    from PIL import Image

    temporary, fps = Path(path).with_name(f".part-{Path(path).name}"), 1 / (TIME_STEP * every)
    try:
        if str(path).endswith(".mp4"):
            import imageio

            with imageio.get_writer(temporary, fps=fps, macro_block_size=None) as video:
                for picture in frames(agents, seeds, every):
                    video.append_data(picture)
        else:
            images = [Image.fromarray(picture).quantize(64) for picture in frames(agents, seeds, every)]
            of_gif = dict(save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
            images[0].save(temporary, "GIF", **of_gif)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check_output(parser, name, path, suffix=""):
    """Ends with 2 where the flag `name`'s path cannot become a file, or does not end in the suffix."""
    if path.is_dir() or not path.absolute().parent.is_dir():
        parser.error(f"--{name} {path}: is a folder, or its folder does not exist")
    if not path.name.endswith(suffix):
        parser.error(f"--{name} {path}: its name must end in {suffix}")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, usage=argparse.SUPPRESS, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=TASKS, default="p2p")
    job = parser.add_mutually_exclusive_group(required=True)
    job.add_argument("--record", type=int, metavar="N", help="record N episodes into --out")
    job.add_argument("--trials", type=int, metavar="N", help="run N episodes and print the mean success, length, ...")
    job.add_argument("--watch", action="store_true", help="three episodes in PyBullet's window")
    job.add_argument("--gif", type=logx.path, metavar="FILE", help="three episodes into a GIF")
    parser.add_argument("--out", type=logx.path, metavar="FILE", help="the .npz of --record")
    parser.add_argument("--gains", choices=GAINS, default="authors")
    for name, i in (("K_P", 0), ("K_D", 1), ("K_I", 2)):
        parser.add_argument(f"--{name}", type=float, help=f"instead of that of --gains ({GAINS['authors'][i]})")
    for name, value, what in (("clearance", None, "of the way above the cube (P2P-O, 0.18), before it (P&P, 0.15)"),
                              ("retract", RETRACT, f"radius to draw back to beside a cube (P2P-O, {RETRACT})"),
                              ("radius", RADIUS, f"over which the parts of P2P-O's way blend ({RADIUS})")):  # fmt: skip
        parser.add_argument(f"--{name}", type=float, default=value, metavar="M", help=f"{what}, in m")
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation of noise on recorded actions")
    parser.add_argument("--stage", choices=STAGES, default="demo")
    parser.add_argument("--symmetry", choices=("none", "gas"), default="none", help="gas: record one partition, map it")
    parser.add_argument("--partitions", type=int, default=4, metavar="K")
    parser.add_argument("--seed", type=int, default=0)
    flags = parser.parse_args()
    for name in ("record", "trials", "partitions"):
        if getattr(flags, name) is not None and getattr(flags, name) < 1:
            parser.error(f"--{name} {getattr(flags, name)}: must be at least 1")
    if flags.seed < 0:
        parser.error(f"--seed {flags.seed}: must be 0 or more")
    if (flags.record is None) != (flags.out is None):
        parser.error("--record and --out: give both or neither")
    if flags.symmetry == "gas" and flags.stage != "demo":
        parser.error(f"--symmetry gas: needs --stage demo, not {flags.stage}")
    for name, suffix in (("out", ""), ("gif", ".gif")):
        if getattr(flags, name) is not None:
            check_output(parser, name, getattr(flags, name), suffix)
    gains = [
        own if own is not None else named
        for own, named in zip((flags.K_P, flags.K_D, flags.K_I), GAINS[flags.gains], strict=True)
    ]
    if min(gains) < 0 or not np.all(np.isfinite(gains)):
        parser.error(f"--K_P --K_D --K_I {gains}: must be finite and not negative")
    for name, low, high in (("clearance", 0, 0.5), ("retract", 0.1, 1), ("radius", 0.001, 0.5), ("noise", 0, 10)):
        if getattr(flags, name) is not None and not low <= getattr(flags, name) <= high:
            parser.error(f"--{name} {getattr(flags, name)}: must be at least {low} and at most {high}")
    way = {name: getattr(flags, name) for name in ("clearance", "radius", "retract")}

    if flags.watch or flags.gif:
        mode = "human" if flags.watch else "rgb_array"
        size = dict(width=480, height=360)
        try:
            env = gymnasium.make(TASKS[flags.task].env_id, stage=flags.stage, partitions=flags.partitions,
                                 render_mode=mode, **size)  # fmt: skip
            pid = PID(env, gains, **way)
            if flags.gif:
                film({"PID": (env, lambda s: pid.act())}, flags.gif, [flags.seed + n for n in range(3)])
                print(f"wrote {flags.gif}")
            for n in range(0 if flags.gif else 3):
                env.reset(seed=flags.seed + n)
                while not any(env.step(pid.act())[2:4]):
                    pass
            env.close()
        except ValueError as error:
            parser.error(f"--{error}" if flags.gif else f"--watch: {error}")
        except OSError as error:
            parser.error(f"--gif {flags.gif}: cannot be written ({error.strerror or error})")
        return

    settings = dict(gains=gains, seed=flags.seed, partitions=flags.partitions, symmetry=flags.symmetry)
    settings |= dict(noise=flags.noise, **way)
    try:
        demos, steps = record(flags.task, flags.record or flags.trials, **settings, stage=flags.stage, quiet=False)
    except ValueError as error:
        parser.error(f"--{error}")
    won = demos["success"]
    length = f"{demos['length'][won].mean():.0f} steps" if won.any() else "no success"
    print(
        f"{flags.task} {flags.stage}, K_P K_D K_I = {gains}: {len(won)} episodes, {steps} environment steps\n"
        f"success {100 * won.mean():.1f} %, length of the successful {length}, return {demos['return'].mean():.2f}, "
        f"effort {demos['effort'].mean():.1f} %, mean |a| {np.abs(demos.get('executed', demos['act'])).mean():.3f}"
    )
    if flags.record:
        meta = json.dumps(dict(task=flags.task, stage=flags.stage, env_steps=steps, **settings))
        try:
            logx.atomic_write(flags.out, lambda file: np.savez_compressed(file, **demos, meta=np.array(meta)))
        except OSError as error:
            parser.error(f"--out {flags.out}: cannot be written ({error.strerror or error})")
        print(f"wrote {flags.out}")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit(130) from None
