"""evaluate.py: trials by hand on a scripted environment, the same for every agent, and safe loading of policies."""

import csv
import importlib.util
import json
import math
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from PIL import Image

import ddpg_demoease as ddpg
import evaluate
import gas
import logx
import pid_demo
from kinova_env import TASKS

HEADER = "trial,success,failure,grasped,length,return,effort_percent,final_error_cm,e95_cm,goal_theta,goal_rho,goal_z"


class Object:
    """Not a plain type."""


@pytest.fixture(autouse=True)
def one_thread():
    """As in training and in evaluate's own processes: the same sums in the same order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def learner(task="p2p", symmetry="none", seed=0):
    """An untrained actor as a training run holds it."""
    torch.manual_seed(seed)
    flags = ddpg.complete(ddpg.Flags(task=task, symmetry=symmetry, hidden_sizes=(16, 16)))[0]
    return ddpg.Learner(flags, 22 if task == "p2p" else 25)


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A run folder with a policy.pt."""
    folder = tmp_path_factory.mktemp("runs") / "a run"
    folder.mkdir()
    logx.atomic_write(folder / "policy.pt", lambda file: torch.save(learner().policy(), file))
    return folder


def saved(folder, stored):
    folder.mkdir(exist_ok=True)
    logx.atomic_write(folder / "policy.pt", lambda file: torch.save(stored, file))
    return folder


# ---- one trial -------------------------------------------------------------------------------------------------------


class Scripted:
    """An environment that plays a list of (distance, reward, effort) and then ends as told; notes what it is given."""

    def __init__(self, script, terminated, **last):
        self.script, self.terminated, self.last = script, terminated, last
        self.unwrapped = SimpleNamespace(goal=[-0.3, 0.4, 0.5], tcp=(0.0, 0.0, 0.0))
        self.seeds, self.actions = [], []

    def info(self, distance, effort, **more):
        return {"is_success": False, "collision": "", "grasped": False, "distance": distance, "effort": effort} | more

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        self.t = 0
        return np.zeros(3), self.info(1.0, 0.0)

    def step(self, action):
        self.actions.append(action)
        self.unwrapped.tcp = (0.1 * (self.t + 1), 0.0, 0.5)
        distance, reward, effort = self.script[self.t]
        self.t += 1
        done = self.t == len(self.script)
        info = self.info(distance, effort, **(self.last if done else {}))
        return np.full(3, self.t), reward, done and self.terminated, done and not self.terminated, info


def test_a_row_follows_by_hand():
    n = 41  # the last 5 % are 2.05 steps: 3
    script = [(0.9 - 0.02 * t, -0.01 * t, 0.1 + 0.001 * t) for t in range(n)]
    env = Scripted(script, True, is_success=True, grasped=True)
    row, errors, path, start = evaluate.trial(env, lambda s: s.copy(), 7)
    np.testing.assert_array_equal(start, [env.unwrapped.goal, [np.nan] * 3])
    assert list(row) == HEADER.split(",")
    assert row.pop("return") == pytest.approx(-0.01 * sum(range(n)))
    assert row.pop("effort_percent") == pytest.approx(100 * (0.1 + 0.001 * 20) / 2)  # of norm(tau_hat) <= 2
    assert row.pop("final_error_cm") == pytest.approx(10)
    assert row.pop("e95_cm") == pytest.approx(np.mean([10, 12, 14]))
    assert row.pop("goal_theta") == pytest.approx(math.atan2(0.4, -0.3)) and row.pop("goal_rho") == pytest.approx(0.5)
    assert row == {"trial": 7, "success": 1, "failure": "", "grasped": 1, "length": n, "goal_z": 0.5}
    assert errors == pytest.approx([1.0] + [0.9 - 0.02 * t for t in range(n)])  # e_0 to e_T
    np.testing.assert_allclose(path, [(0, 0, 0)] + [(0.1 * t, 0, 0.5) for t in range(1, n + 1)], rtol=1e-6)
    assert [a[0] for a in env.actions] == list(range(n))  # act saw each state once, in order


@pytest.mark.parametrize("n, last", [(1, 1), (19, 1), (20, 1), (21, 2), (100, 5), (400, 20)])
def test_e95_is_over_the_last_twentieth_of_the_steps_and_at_least_one(n, last):
    script = [(0.01 * (n - t), 0.0, 0.0) for t in range(n)]
    row, *_ = evaluate.trial(Scripted(script, False), lambda s: 0, 0)
    assert row["e95_cm"] == pytest.approx(np.mean([k for k in range(1, last + 1)])) and row["length"] == n


@pytest.mark.parametrize("terminated, last, failure", [
    (True, dict(is_success=True), ""),
    (True, dict(collision="cube"), "cube"),
    (True, dict(collision="self", grasped=True), "self"),
    (False, dict(), "timeout"),
    (False, dict(is_success=True), ""),
    (True, dict(is_success=True, collision="cube"), ""),
])  # fmt: skip
def test_a_failure_is_named_by_what_ended_the_trial(terminated, last, failure):
    row, *_ = evaluate.trial(Scripted([(0.1, 0, 0), (0.1, 0, 0)], terminated, **last), lambda s: 0, 0)
    assert row["failure"] == failure and row["success"] == int(failure == "")
    assert row["grasped"] == int(last.get("grasped", False))


def test_trials_are_seeded_by_their_number_far_from_training_seeds():
    env = Scripted([(0.1, 0, 0)], False)
    for i in (0, 1, 499):
        evaluate.trial(env, lambda s: 0, i)
    assert env.seeds == [1_000_000, 1_000_001, 1_000_499]


@pytest.mark.parametrize("task", TASKS)
def test_trial_i_is_the_same_goal_for_every_agent_and_after_any_other_trial(task):
    env = gymnasium.make(TASKS[task].env_id, stage="test", disable_env_checker=True, max_episode_steps=40)
    pid = pid_demo.PID(env, "fast")
    agents = {"rest": lambda s: np.zeros(4, np.float32), "PID": lambda s: pid.act(),
              "down": lambda s: np.array([0, 1, 1, 0], np.float32)}  # fmt: skip
    rows = {name: [evaluate.trial(env, act, i)[0] for i in (0, 1, 2)] for name, act in agents.items()}
    goals = {name: [(r["goal_theta"], r["goal_rho"], r["goal_z"]) for r in trials] for name, trials in rows.items()}
    assert goals["rest"] == goals["PID"] == goals["down"] and len(set(goals["rest"])) == 3
    assert [evaluate.trial(env, agents["PID"], i)[0] for i in (2, 0)] == [rows["PID"][2], rows["PID"][0]]
    env.close()


# ---- many trials -----------------------------------------------------------------------------------------------------


def test_nothing_depends_on_the_number_of_jobs(run_folder):
    one, two = (evaluate.run_trials("p2p", run_folder, trials=11, jobs=jobs, quiet=True) for jobs in (1, 2))
    assert one[0] == two[0] and [row["trial"] for row in one[0]] == list(range(11))
    assert len({row["e95_cm"] for row in one[0]}) == 11
    assert one[1].keys() == two[1].keys()
    for name in one[1]:
        np.testing.assert_array_equal(one[1][name], two[1][name])


def test_the_first_trials_of_a_longer_study_are_the_shorter_one():
    rows, _ = evaluate.run_trials("p2p", "fast", trials=12, quiet=True)
    assert rows[:3] == evaluate.run_trials("p2p", "fast", trials=3, quiet=True)[0] and len(rows) == 12
    assert any(row["success"] for row in rows)


@pytest.mark.parametrize("task", TASKS)
def test_trajectories_are_those_of_the_trials_one_after_another(monkeypatch, task):
    monkeypatch.setattr(evaluate, "PATHS", 2)
    rows, kept = evaluate.run_trials(task, "fast", trials=3, quiet=True)
    assert kept["length"].tolist() == [row["length"] for row in rows]
    assert kept["success"].tolist() == [bool(row["success"]) for row in rows]
    ends = np.cumsum(kept["length"] + 1)
    assert len(kept["error"]) == ends[-1] and len(kept["tcp"]) == ends[1] and kept["tcp"].shape[1] == 3
    np.testing.assert_allclose(100 * kept["error"][ends - 1], [row["final_error_cm"] for row in rows], rtol=1e-5)
    distance = np.linalg.norm(kept["tcp"] - np.repeat(kept["goal"], kept["length"][:2] + 1, axis=0), axis=1)
    np.testing.assert_allclose(distance, kept["error"][: ends[1]], atol=1e-5)
    assert kept["object"].shape == (2, 3) and np.isnan(kept["object"]).all() == (task == "p2p")


def trial_row(success, **values):
    return dict.fromkeys(HEADER.split(","), 0.0) | {"success": success, "failure": "" if success else "self"} | values


def test_metrics_average_the_successful_trials_only():
    rows = [trial_row(1, effort_percent=10, length=100, e95_cm=4, **{"return": 9.0}),
            trial_row(0, effort_percent=90, length=400, e95_cm=80, **{"return": -2.0}),
            trial_row(1, effort_percent=20, length=140, e95_cm=6, **{"return": 9.5}),
            trial_row(0, effort_percent=90, length=400, e95_cm=80, **{"return": -2.0})]  # fmt: skip
    assert evaluate.metrics(rows) == {"P_scs_percent": 50, "T_eff": 15, "R_test": 9.25, "E_95_cm": 5, "steps": 120}


def test_intervals_are_wilsons_for_success_and_students_for_the_means():
    rows = [trial_row(1, effort_percent=x, length=100) for x in (10, 12, 14, 20)] + [trial_row(0)] * 6
    found = evaluate.intervals(rows)
    z, n, p = 1.959964, 10, 0.4
    centre = (p + z**2 / 2 / n) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / 4 / n**2)
    assert found["P_scs_percent"] == pytest.approx((100 * (centre - half), 100 * (centre + half)), rel=1e-5)
    half = 3.182446 * math.sqrt(56 / 3) / 2  # t of 3 degrees of freedom; squared deviations 16 + 4 + 0 + 36
    assert found["T_eff"] == pytest.approx((14 - half, 14 + half), rel=1e-5)
    assert found["steps"] == pytest.approx((100, 100))


def test_success_is_counted_by_the_quarter_the_goal_is_in():
    angles = [(-3.1, 1), (-1.6, 0), (-1.5, 1), (0.1, 0), (0.2, 0), (3.1, 1), (-math.pi, 1), (math.pi, 1)]
    assert evaluate.sectors([trial_row(won, goal_theta=t) for t, won in angles])[:3] == [75, 100, 0]
    assert math.isnan(evaluate.sectors([trial_row(1, goal_theta=-3.0)])[3])


def test_paired_differences_are_over_the_same_trials_and_where_both_succeed():
    one = [trial_row(1, length=100), trial_row(1, length=120), trial_row(0, length=400), trial_row(1, length=90)]
    two = [trial_row(1, length=110), trial_row(0, length=400), trial_row(0, length=400), trial_row(1, length=130)]
    found = evaluate.paired(one, two)
    mean, low, high = found["P_scs_percent"]
    assert mean == 25 and low == 0 and 50 <= high <= 75
    mean, low, high = found["steps"]
    assert (mean, low, high) == (-25, -40, -10)  # two pairs: the interval is all of them
    assert evaluate.paired(one, one)["P_scs_percent"] == (0, 0, 0)
    assert math.isnan(evaluate.paired(two[1:3], one[1:3])["T_eff"][0])


def test_metrics_are_nan_and_the_table_still_prints_where_no_trial_succeeded(capsys):
    rows = [trial_row(0), trial_row(0, failure="timeout"), trial_row(0)]
    m = evaluate.metrics(rows)
    assert m.pop("P_scs_percent") == 0 and len(m) == 4 and all(math.isnan(value) for value in m.values())
    evaluate.print_table({"an agent": rows})
    line = capsys.readouterr().out.splitlines()[1]
    assert line.split()[:4] == ["an", "agent", "3", "0.0"] and line.endswith("2 self, 1 timeout")


# ---- policies --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("symmetry", ["none", "gas", "so2", "canonical"])
def test_a_loaded_policy_acts_as_the_actor_did_in_training(tmp_path, task, symmetry):
    agent = learner(task, symmetry, seed=5)
    with torch.no_grad():
        agent.net.flat.mul_(3)  # far into the tanh
    policy = evaluate.load_policy(saved(tmp_path / "run", agent.policy()))
    env = gymnasium.make(TASKS[task].env_id, stage="train", disable_env_checker=True)
    env.action_space.seed(0)
    s, _ = env.reset(seed=0)
    differs = 0
    for _ in range(20):
        view = gas.canonical(s) if symmetry == "canonical" else s
        with torch.inference_mode():
            a = torch.tanh(agent.actor(torch.from_numpy(view))).numpy()
            raw = torch.tanh(agent.actor(torch.from_numpy(s))).numpy()
        assert np.array_equal(policy(s), a) and policy(s).dtype == np.float32 and policy(s).shape == (4,)
        differs += not np.array_equal(a, raw)
        s = env.step(env.action_space.sample())[0]
    assert policy.task == task and differs == (20 if symmetry == "canonical" else 0)
    env.close()


def test_a_canonical_policy_acts_alike_in_a_turned_world(tmp_path):
    policy = evaluate.load_policy(saved(tmp_path / "run", learner(symmetry="canonical").policy()))
    other = evaluate.load_policy(saved(tmp_path / "other", learner(symmetry="so2").policy()))
    env = gymnasium.make("KinovaP2P-v0", disable_env_checker=True)
    s, _ = env.reset(seed=0)
    assert np.allclose(policy(gas.rotate(s, 1.3)), policy(s), atol=1e-5)
    assert not np.allclose(other(gas.rotate(s, 1.3)), other(s), atol=1e-3)
    env.close()


def test_a_linear_policy_is_clipped_to_the_action_range(tmp_path):
    stored = learner().policy() | {"output": "linear"}
    stored["weights"]["4.bias"] = torch.tensor([50.0, -50.0, 0.3, 0.0])
    stored["weights"]["4.weight"] = torch.zeros(4, 16)
    act = evaluate.load_policy(saved(tmp_path / "run", stored))
    assert act(np.zeros(22, np.float32)).tolist() == pytest.approx([1, -1, 0.3, 0])


def bad_policies():
    """{what: bytes of a policy.pt that load_policy must refuse, or what to save in it}."""
    good = learner().policy()
    whole = Path("policy.pt")
    three = {"4.weight": torch.zeros(3, 16), "4.bias": torch.zeros(3)}
    return {
        "missing": None,
        "empty": b"",
        "text": b"not a policy\n",
        "pickled object": pickle.dumps(Object()),
        "object saved by torch": {"weights": Object()},
        "truncated": whole,
        "a tensor": torch.zeros(3),
        "a list": [1, 2],
        "no weights": {key: value for key, value in good.items() if key != "weights"},
        "no sizes": {key: value for key, value in good.items() if key != "sizes"},
        "unknown task": good | {"task": "p3p"},
        "another task's observation": good | {"task": "pnp"},
        "other sizes": good | {"sizes": [22, 8, 8, 4]},
        "sizes of text": good | {"sizes": ["22", "4"]},
        "weights of another kind": good | {"weights": [1.0]},
        "a weight that is no tensor": good | {"weights": good["weights"] | {"0.bias": "x"}},
        "three actions": good | {"sizes": [22, 16, 16, 3], "weights": good["weights"] | three},
    }  # fmt: skip


def put(folder, what):
    """A run folder with this bad policy."""
    folder.mkdir()
    content = bad_policies()[what]
    if isinstance(content, bytes):
        (folder / "policy.pt").write_bytes(content)
    elif isinstance(content, Path):
        saved(folder, learner().policy())
        (folder / "policy.pt").write_bytes((folder / "policy.pt").read_bytes()[:-300])
    elif content is not None:
        saved(folder, content)
    return folder


@pytest.mark.filterwarnings("error")  # a warning is a second line on standard error
@pytest.mark.parametrize("what", bad_policies())
def test_a_file_that_is_no_policy_is_refused_with_one_line_that_names_it(tmp_path, what):
    folder = put(tmp_path / "run", what)
    with pytest.raises(ValueError) as refused:
        evaluate.load_policy(folder)
    assert str(folder / "policy.pt") in str(refused.value) and "\n" not in str(refused.value)


# ---- command line ----------------------------------------------------------------------------------------------------


def main(monkeypatch, *argv):
    """evaluate.main() with this command line; the exit code."""
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *map(str, argv)])
    try:
        evaluate.main()
    except SystemExit as stopped:
        return stopped.code
    return 0


def test_a_study_of_a_run_prints_its_row_and_writes_every_trial(tmp_path, monkeypatch, capsys):
    folder = saved(tmp_path / "run", learner().policy())
    (folder / "evaluation.csv").write_text("of an earlier study")
    assert main(monkeypatch, folder, "--trials", 3) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].split()[0] == "agent" and out[1].split()[:2] == [str(folder), "3"]
    assert sorted(path.name for path in folder.iterdir()) == ["evaluation.csv", "policy.pt", "trajectories.npz"]
    text = (folder / "evaluation.csv").read_bytes().decode()
    assert text.startswith(HEADER + "\n") and text.count("\n") == 4 and "\r" not in text
    for written, row in zip(csv.DictReader(text.splitlines()), evaluate.run_trials("p2p", folder, 3, quiet=True)[0],
                            strict=True):  # fmt: skip
        assert written["failure"] == row.pop("failure")
        assert {name: float(written[name]) for name in row} == pytest.approx(row, rel=1e-5)
        assert written["success"] in "01" and written["grasped"] in "01"


def test_a_study_that_fails_leaves_the_earlier_one_whole(tmp_path, monkeypatch):
    folder = saved(tmp_path / "run", learner().policy())
    evaluate.write_csv(folder / "evaluation.csv", [trial_row(1)])
    before = (folder / "evaluation.csv").read_bytes()
    assert before.startswith(HEADER.encode() + b"\n") and before.count(b"\n") == 2
    with pytest.raises(ValueError):
        evaluate.write_csv(folder / "evaluation.csv", [trial_row(0), trial_row(0) | {"no such column": 1}])
    assert (folder / "evaluation.csv").read_bytes() == before


def test_a_study_of_several_runs_gives_each_its_own_file(tmp_path, monkeypatch, capsys):
    folders = [saved(tmp_path / name, learner(seed=n).policy()) for n, name in enumerate(("a", "b"))]
    assert main(monkeypatch, *folders, "--trials", 1) == 0
    rows = [(folder / "evaluation.csv").read_text() for folder in folders]
    assert rows[0] != rows[1] and all(row.count("\n") == 2 for row in rows)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:3]] == [str(f) for f in folders]


def test_a_study_versus_another_run_prints_the_paired_differences(tmp_path, monkeypatch, capsys):
    one, two = (saved(tmp_path / name, learner(seed=n).policy()) for n, name in enumerate(("a", "b")))
    assert main(monkeypatch, one, "--versus", two, "--trials", 2) == 0
    out = capsys.readouterr().out
    assert f"{one} less {two}, the same trials" in out and "P_scs_percent  0.00 [0.00, 0.00]" in out
    assert (two / "evaluation.csv").exists()


def test_a_study_of_the_demonstrator_prints_its_row(monkeypatch, capsys):
    assert main(monkeypatch, "--pid", "--task", "p2p", "--gains", "fast", "--trials", 2) == 0
    line = capsys.readouterr().out.splitlines()[1]
    assert line.startswith("PID, fast gains, p2p") and line.split()[4] == "2"


def test_trials_of_the_demonstrator_are_kept_where_a_folder_is_given(tmp_path, monkeypatch):
    out = tmp_path / "pid-p2p-fast"
    assert main(monkeypatch, "--pid", "--task", "p2p", "--gains", "fast", "--trials", 2, "--out", out) == 0
    config = json.loads((out / "config.json").read_text())
    assert (config["task"], config["algo"], config["gains"]) == ("p2p", "pid", "fast")
    assert (out / "evaluation.csv").read_text().count("\n") == 3
    with np.load(out / "trajectories.npz", allow_pickle=False) as kept:
        assert len(kept["length"]) == 2


def test_agents_are_filmed_side_by_side_on_the_trials_chosen(tmp_path, monkeypatch):
    folder, make, seeds = saved(tmp_path / "run", learner().policy()), gymnasium.make, []

    def short_make(id_, **settings):
        env = make(id_, **(settings | {"width": 32, "height": 24, "max_episode_steps": 5}))
        reset = env.reset
        env.reset = lambda seed: seeds.append(seed) or reset(seed=seed)
        return env

    monkeypatch.setattr(gymnasium, "make", short_make)
    words = [folder, "--pid", "--task", "p2p", "--gif", tmp_path / "both.gif", "--show", 4, 2]
    assert main(monkeypatch, *words) == 0
    assert seeds == [1_000_004, 1_000_004, 1_000_002, 1_000_002]
    with Image.open(tmp_path / "both.gif") as image:
        assert image.size == (64, 24) and image.n_frames > 1
    assert main(monkeypatch, folder, "--mp4", tmp_path / "one.mp4", "--show", 0) in (0, 2)
    assert (tmp_path / "one.mp4").exists() == bool(importlib.util.find_spec("imageio_ffmpeg"))


BAD = {
    "neither a run nor the PID": ([], "--pid"),
    "the PID without a task": (["--pid"], "--task"),
    "an unknown task": (["--pid", "--task", "p3p"], "--task"),
    "unknown gains": (["--pid", "--task", "p2p", "--gains", "x"], "--gains"),
    "no trials": (["{run}", "--trials", "0"], "--trials"),
    "a negative number of trials": (["{run}", "--trials", "-3"], "--trials"),
    "half a trial": (["{run}", "--trials", "1.5"], "--trials"),
    "no jobs": (["{run}", "--jobs", "0"], "--jobs"),
    "an unknown folder": (["{tmp}/nowhere"], "nowhere"),
    "a file": (["{run}/policy.pt"], "policy.pt"),
    "a run and an unknown folder": (["{run}", "{tmp}/nowhere"], "nowhere"),
    "an unknown flag": (["{run}", "--nonsense"], "--nonsense"),
    "a GIF in no folder": (["{run}", "--gif", "{tmp}/nowhere/a.gif"], "--gif"),
    "a GIF of two tasks": (["{run}", "--pid", "--task", "pnp", "--gif", "{tmp}/a.gif"], "--gif"),
    "two tasks compared": (["--pid", "--task", "pnp", "--versus", "{run}"], "--versus"),
    "a GIF named as a video": (["{run}", "--gif", "{tmp}/a.mp4"], ".gif"),
    "a GIF of no name": (["{run}", "--gif="], "--gif"),
    "no folder for the PID's trials": (["--pid", "--task", "p2p", "--out="], "--out"),
    "a task of a run": (["{run}", "--task", "p2p"], "--task"),
    "gains of a run": (["{run}", "--gains", "fast"], "--gains"),
    "a window for two": (["{run}", "--pid", "--task", "p2p", "--watch"], "--watch"),
    "a film twice": (["{run}", "--gif", "{tmp}/a.gif", "--watch"], "--gif"),
    "a trial before the first": (["{run}", "--gif", "{tmp}/a.gif", "--show", "-1"], "--show"),
    "a folder for a run's trials": (["{run}", "--out", "{tmp}/out"], "--out"),
    "an unknown run to compare with": (["{run}", "--versus", "{tmp}/nowhere"], "nowhere"),
    "missing": (["{tmp}/bad"], "policy.pt"),
    "truncated": (["{tmp}/bad"], "policy.pt"),
    "pickled object": (["{tmp}/bad"], "policy.pt"),
    "a tensor": (["{tmp}/bad"], "policy.pt"),
    "another task's observation": (["{tmp}/bad"], "policy.pt"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_exit_code_2_and_one_line_that_names_it(what, run_folder, tmp_path, monkeypatch, capsys):
    argv, named = BAD[what]
    if "{tmp}/bad" in argv:
        put(tmp_path / "bad", what)
    before = sorted(tmp_path.rglob("*"))
    capsys.readouterr()
    code = main(monkeypatch, *(word.format(run=run_folder, tmp=tmp_path) for word in argv), "--trials" not in argv
                and "--trials=1" or "--jobs=1")  # fmt: skip
    out, err = capsys.readouterr()
    assert code == 2 and not out and err.count("\n") == 1 and named in err
    assert sorted(tmp_path.rglob("*")) == before and not (run_folder / "evaluation.csv").exists()


def test_a_film_that_cannot_be_written_is_one_line_and_leaves_nothing(run_folder, tmp_path, monkeypatch, capsys):
    def no_room(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pid_demo.os, "replace", no_room)
    assert main(monkeypatch, run_folder, "--gif", tmp_path / "a.gif", "--show", 0) == 2
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and "a.gif: cannot be written (No space left on device)" in err
    assert not list(tmp_path.glob("*.gif")) and not list(tmp_path.glob(".part*"))


def test_a_published_run_is_tested_and_left_as_it_is(run_folder, tmp_path, monkeypatch, capsys):
    published = tmp_path / "results"
    published.mkdir()
    (published / "policy.pt").write_bytes((run_folder / "policy.pt").read_bytes())
    (published / "evaluation.csv.gz").write_bytes(b"as it was")
    assert main(monkeypatch, published, "--trials", 1) == 0
    assert "stay as they are" in capsys.readouterr().out
    assert sorted(path.name for path in published.iterdir()) == ["evaluation.csv.gz", "policy.pt"]


def test_the_cube_of_a_pick_and_place_trial_is_where_it_was_at_the_start():
    _, trajectories = evaluate.run_trials("pnp", "fast", trials=1, quiet=True)
    env = gymnasium.make(TASKS["pnp"].env_id, stage="test")
    env.reset(seed=evaluate.FIRST_SEED)
    np.testing.assert_array_equal(trajectories["object"], [env.unwrapped.cube])
    assert trajectories["success"][0] and np.linalg.norm(trajectories["object"] - trajectories["goal"]) > 0.06
