"""evaluate.py: trials by hand on a scripted environment, the same for every agent; metrics, intervals, policies."""

import csv
import fcntl
import json
import math
import os
import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import stats

import ddpg_demoease as ddpg
import evaluate
import gas
import kinova_env
import logx
from kinova_env import OBS_DIM, TASKS

HEADER = "trial,success,failure,grasped,length,return,effort_percent,final_error_cm,e95_cm,goal_theta,goal_rho,goal_z"
TRAIN_START = (math.pi / 4, 0.52, 0.42)


def rest(s):
    return np.zeros(4, np.float32)


def stored(task="p2p", symmetry="none", seed=0, **changes):
    """What policy.pt holds of an untrained policy."""
    sizes = [OBS_DIM[task] + bool(changes.get("grasp_input")), 16, 4]
    generator = torch.Generator().manual_seed(seed)
    weights = {name: torch.randn(shape, generator=generator) for name, shape in (
        ("0.weight", (16, sizes[0])), ("0.bias", (16,)), ("2.weight", (4, 16)), ("2.bias", (4,)))}  # fmt: skip
    return {"task": task, "symmetry": symmetry, "sizes": sizes, "output": "tanh", "weights": weights} | changes


def saved(folder, policy):
    folder.mkdir(exist_ok=True)
    logx.atomic_write(folder / "policy.pt", lambda file: torch.save(policy, file))
    return folder


@pytest.fixture
def run_folder(tmp_path):
    folder = saved(tmp_path / "a run", stored())
    (folder / "config.json").write_text(json.dumps({"task": "p2p", "algo": "ddpg", "recipe": "robust"}))
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
    assert env.seeds == [1_000_007]


@pytest.mark.parametrize("n, last", [(1, 1), (20, 1), (21, 2), (140, 7), (400, 20)])  # 0.05 * 140 > 7 in floats
def test_e95_is_over_the_last_twentieth_of_the_steps_and_at_least_one(n, last):
    script = [(0.01 * (n - t), 0.0, 0.0) for t in range(n)]
    row, *_ = evaluate.trial(Scripted(script, False), rest, 0)
    assert row["e95_cm"] == pytest.approx(np.mean([k for k in range(1, last + 1)])) and row["length"] == n


@pytest.mark.parametrize("terminated, last, failure", [
    (True, dict(is_success=True), ""),
    (True, dict(collision="cube"), "cube"),
    (False, dict(), "timeout"),
    (True, dict(is_success=True, collision="cube"), ""),
])  # fmt: skip
def test_a_failure_is_named_by_what_ended_the_trial(terminated, last, failure):
    row, *_ = evaluate.trial(Scripted([(0.1, 0, 0), (0.1, 0, 0)], terminated, **last), rest, 0)
    assert row["failure"] == failure and row["success"] == int(failure == "")


# ---- many trials -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_trial_i_has_the_same_goal_for_every_agent_start_and_horizon_and_after_any_other(task):
    def goals(source, numbers=(0, 1, 2), **settings):
        found = [evaluate.run_trials(task, source, 1, i, quiet=True, **settings)[0][0] for i in numbers]
        return np.array([[row[f"goal_{name}"] for name in ("theta", "rho", "z")] for row in found])

    first = goals(rest, horizon=5)
    assert len(np.unique(first[:, 0])) == 3
    np.testing.assert_array_equal(goals("fast", horizon=9), first)
    np.testing.assert_array_equal(goals(rest, (2, 0), horizon=5), first[[2, 0]])
    np.testing.assert_allclose(goals(rest, start=TRAIN_START, horizon=5), first, rtol=1e-12)


def test_another_start_changes_the_start_pose_and_only_a_cube_that_is_in_its_way():
    plain, _ = evaluate.make_agent("p2po", rest)
    moved, _ = evaluate.make_agent("p2po", rest, start=TRAIN_START)
    same = 0
    for i in range(100):
        for env in (plain, moved):
            env.reset(seed=evaluate.FIRST_SEED + i)
        np.testing.assert_allclose(moved.unwrapped.goal, plain.unwrapped.goal, rtol=1e-12)
        np.testing.assert_allclose(moved.unwrapped.tcp, kinova_env.cartesian(*TRAIN_START), atol=1e-6)
        same += np.allclose(moved.unwrapped.cube, plain.unwrapped.cube)
        s, _, terminated, *_ = moved.step(np.zeros(4))
        assert not terminated
    assert 90 <= same < 100
    plain.close()
    moved.close()


def test_the_horizon_is_the_number_of_steps_until_a_timeout():
    (row,), _ = evaluate.run_trials("p2p", rest, 1, horizon=7, quiet=True)
    assert (row["length"], row["failure"]) == (7, "timeout")


def test_nothing_depends_on_the_number_of_jobs():
    one, two = (evaluate.run_trials("p2p", "fast", 11, 3, horizon=60, jobs=jobs, quiet=True) for jobs in (1, 2))
    assert one[0] == two[0] and [row["trial"] for row in one[0]] == list(range(3, 14))
    assert len({row["e95_cm"] for row in one[0]}) == 11
    assert one[1].keys() == two[1].keys()
    for name in one[1]:
        np.testing.assert_array_equal(one[1][name], two[1][name])


def test_trials_have_their_number_wherever_a_study_begins():
    rows, _ = evaluate.run_trials("p2p", "fast", trials=12, quiet=True)
    assert rows[9:] == evaluate.run_trials("p2p", "fast", 3, first_trial=9, quiet=True)[0]
    assert len(rows) == 12 and any(row["success"] for row in rows)


def test_a_folder_its_policy_and_any_callable_are_tested_alike(run_folder):
    policy = evaluate.load_policy(run_folder)
    sources = (run_folder, str(run_folder / "policy.pt"), lambda obs: policy(obs))
    one, two, three = (evaluate.run_trials("p2p", s, 2, horizon=20, quiet=True)[0] for s in sources)
    assert one == two == three
    with pytest.raises(logx.BadInput, match="of task p2p, not of pnp"):
        evaluate.run_trials("pnp", run_folder, 1)


def test_trajectories_are_those_of_the_trials_one_after_another(monkeypatch):
    monkeypatch.setattr(evaluate, "PATHS", 2)
    for task in ("p2p", "pnp"):
        rows, kept = evaluate.run_trials(task, "fast", trials=3, quiet=True)
        assert kept["length"].tolist() == [row["length"] for row in rows]
        assert kept["success"].tolist() == [bool(row["success"]) for row in rows]
        ends = np.cumsum(kept["length"] + 1)
        assert len(kept["error"]) == ends[-1] and kept["tcp"].shape == (ends[1], 3)
        np.testing.assert_allclose(100 * kept["error"][ends - 1], [row["final_error_cm"] for row in rows], rtol=1e-5)
        distance = np.linalg.norm(kept["tcp"] - np.repeat(kept["goal"], kept["length"][:2] + 1, axis=0), axis=1)
        np.testing.assert_allclose(distance, kept["error"][: ends[1]], atol=1e-5)
        assert kept["object"].shape == (2, 3) and np.isnan(kept["object"]).all() == (task == "p2p")
    # the cube's place is that of the start, not the one it was carried to
    assert kept["success"][0] and np.linalg.norm(kept["object"][0] - kept["goal"][0]) > 0.06


def test_training_is_shown_validation_trials_of_its_own_horizon_and_no_random_state_changes(monkeypatch):
    seen, trial = [], evaluate.trial
    monkeypatch.setattr(evaluate, "trial", lambda env, act, i: seen.append(trial(env, act, i)) or seen[-1])
    torch.manual_seed(0)
    np.random.seed(0)
    before = torch.get_rng_state(), np.random.get_state()[1].tolist()
    flags = SimpleNamespace(task="p2p", eval_trials=3, max_ep_len=30)
    found = evaluate.while_training(stored(), flags)
    rows = [row for row, *_ in seen]
    assert [row["trial"] for row in rows] == [10_000, 10_001, 10_002] and max(row["length"] for row in rows) <= 30
    assert found == {name: pytest.approx(np.mean([row[name[5:]] for row in rows]))
                     for name in ("eval_success", "eval_return")}  # fmt: skip
    assert torch.equal(torch.get_rng_state(), before[0]) and np.random.get_state()[1].tolist() == before[1]


# ---- metrics and intervals -------------------------------------------------------------------------------------------


def trial_row(success, **values):
    return dict.fromkeys(HEADER.split(","), 0.0) | {"success": success, "failure": "" if success else "self"} | values


def test_metrics_average_the_successful_trials_only():
    rows = [trial_row(1, effort_percent=10, length=100, e95_cm=4, final_error_cm=2, **{"return": 9.0}),
            trial_row(0, effort_percent=90, length=400, e95_cm=80, **{"return": -2.0}),
            trial_row(1, effort_percent=20, length=140, e95_cm=6, final_error_cm=3, **{"return": 9.5}),
            trial_row(0, effort_percent=90, length=400, e95_cm=80, **{"return": -2.0})]  # fmt: skip
    found = {"P_scs_percent": 50, "T_eff": 15, "R_test": 9.25, "E_95_cm": 5, "steps": 120, "final_error_cm": 2.5}
    assert evaluate.metrics(rows) == found
    pandas = pytest.importorskip("pandas")
    assert evaluate.metrics(pandas.DataFrame(rows)) == found
    assert evaluate.over_trials(pandas.DataFrame(rows)) == evaluate.over_trials(rows)


def test_over_trials_is_wilsons_for_success_and_students_over_the_successful():
    rows = [trial_row(1, effort_percent=x, length=100) for x in (10, 12, 14, 20)] + [trial_row(0)] * 6
    found = evaluate.over_trials(rows)
    z, n, p = 1.959964, 10, 0.4
    centre = (p + z**2 / 2 / n) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / 4 / n**2)
    assert found["P_scs_percent"] == pytest.approx((100 * (centre - half), 100 * (centre + half)), rel=1e-5)
    half = 3.182446 * math.sqrt(56 / 3) / 2  # t of 3 degrees of freedom; squared deviations 16 + 4 + 0 + 36
    assert found["T_eff"] == pytest.approx((14 - half, 14 + half), rel=1e-5)
    assert found["steps"] == pytest.approx((100, 100))


def test_over_seeds_is_students_of_the_known_values_and_nothing_is_known_of_one():
    half = 4.302653 * 1 / math.sqrt(3)  # t of 2 degrees of freedom
    assert evaluate.over_seeds([1, math.nan, 2, 3]) == pytest.approx((2, 2 - half, 2 + half), rel=1e-5)
    assert evaluate.over_seeds([5, 5]) == (5, 5, 5)
    assert evaluate.over_seeds([5, math.nan]) == pytest.approx((5, math.nan, math.nan), nan_ok=True)
    assert all(math.isnan(x) for x in evaluate.over_seeds([math.nan]))


@pytest.mark.filterwarnings("error")
def test_a_difference_is_welchs():
    a, b = [90.0, 95, 97, math.nan], [60.0, 85, 70, 65, 88]
    welch = stats.ttest_ind(a[:3], b, equal_var=False).confidence_interval()
    assert evaluate.difference(a, b) == pytest.approx((94 - 73.6, welch.low, welch.high))
    for few in ([3], [3, 3]):  # two seeds that are the same show no spread: nothing is known of others
        assert evaluate.difference(few, [1, 1]) == pytest.approx((2, math.nan, math.nan), nan_ok=True)
    assert evaluate.difference([3], [1, 2]) == pytest.approx((1.5, math.nan, math.nan), nan_ok=True)


@pytest.mark.parametrize("n", [2, 3, 5, 10])
def test_the_intervals_cover_the_truth_of_normal_seeds(n):
    rng = np.random.default_rng(n)
    a, b = rng.normal(50, 10, (2000, n)), rng.normal(40, 10, (2000, n))
    for truth, found in ((50, map(evaluate.over_seeds, a)), (10, map(evaluate.difference, a, b))):
        _, low, high = np.array(list(found)).T
        assert np.mean((low <= truth) & (truth <= high)) >= 0.93


def test_paired_differences_are_over_the_same_trials_and_where_both_succeed():
    one, two = ([trial_row(won, length=n, trial=i) for i, (won, n) in enumerate(trials)] for trials in (
        [(1, 100), (1, 120), (0, 400), (1, 90)], [(1, 110), (0, 400), (0, 400), (1, 130)]))  # fmt: skip
    found = evaluate.paired(one, two)
    assert found["P_scs_percent"] == evaluate.over_seeds([0, 100, 0, 0])
    assert found["steps"] == evaluate.over_seeds([-10, -40])
    assert evaluate.paired(one, one)["P_scs_percent"] == (0, 0, 0)
    assert math.isnan(evaluate.paired(two[1:3], one[1:3])["T_eff"][0])
    with pytest.raises(ValueError, match="same trials"):
        evaluate.paired(one[:2], two[1:3])


@pytest.mark.filterwarnings("error")
def test_the_table_prints_where_no_trial_succeeded_and_fits_100_columns(capsys):
    lost = [trial_row(0, trial=0), trial_row(0, trial=1, failure="timeout"), trial_row(0, trial=2)]
    values = dict(effort_percent=12.3, length=123, e95_cm=4.56)
    won = [trial_row(1, trial=i, **values, **{"return": 10 + i / 7}) for i in range(3)]
    m = evaluate.metrics(lost)
    assert m.pop("P_scs_percent") == 0 and len(m) == 5 and all(math.isnan(value) for value in m.values())
    evaluate.print_table({"an agent": lost, "another": won}, versus="an agent")
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == "an agent" and lines[2].split() == ["0.0", "[0.0,", "56.1]", "N/A", "N/A", "N/A", "N/A"]
    assert lines[3] == "  3 trials: 2 self, 1 timeout" and max(map(len, lines)) <= 100


# ---- policies --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("symmetry", ["none", "canonical"])
def test_a_loaded_policy_acts_as_the_actor_does_in_training(tmp_path, symmetry):
    torch.manual_seed(5)
    learner = ddpg.Learner(ddpg.resolve(ddpg.Flags(task="p2po", symmetry=symmetry, hidden_sizes=(16, 16))))
    policy = evaluate.load_policy(saved(tmp_path / "run", learner.policy()))
    env, _ = evaluate.make_agent("p2po", rest)
    env.action_space.seed(0)
    s, _ = env.reset(seed=0)
    for _ in range(20):
        assert np.array_equal(policy(s), learner.act(s)) and policy(s).dtype == np.float32
        s = env.step(env.action_space.sample())[0]
    env.close()


def test_a_canonical_policy_acts_alike_in_a_turned_world():
    env, _ = evaluate.make_agent("p2p", rest)
    s, _ = env.reset(seed=0)
    canonical, other = (evaluate.Policy(stored(symmetry=symmetry)) for symmetry in ("canonical", "so2"))
    assert np.allclose(canonical(gas.rotate(s, 1.3)), canonical(s), atol=1e-4)
    assert not np.allclose(other(gas.rotate(s, 1.3)), other(s), atol=1e-2)
    env.close()


def test_a_linear_policy_is_clipped_to_the_action_range():
    policy = stored(output="linear")
    policy["weights"] |= {"2.weight": torch.zeros(4, 16), "2.bias": torch.tensor([50.0, -50.0, 0.3, 0.0])}
    assert evaluate.Policy(policy)(np.zeros(22, np.float32)).tolist() == pytest.approx([1, -1, 0.3, 0])


def test_a_policy_with_a_grasp_input_is_told_whether_the_cube_is_in_the_gripper():
    policy = stored("pnp", grasp_input=True, output="linear")
    policy["weights"] = {name: torch.zeros_like(w) for name, w in policy["weights"].items()}
    policy["weights"]["0.weight"][0, -1] = policy["weights"]["2.weight"][0, 0] = 1.0
    act, s = evaluate.Policy(policy), np.zeros(25, np.float32)
    s[kinova_env.INDEX["pnp"]["P_o"]] = (0.3, 0.3, 0.3)
    assert act(s)[0] == 0
    s[kinova_env.INDEX["pnp"]["P_o"]] = 0  # P_e = P_g - e
    assert act(s)[0] == 1


def test_the_published_policies_act():
    published = sorted(Path(evaluate.__file__).parent.glob("data/results/*/policy.pt"))
    assert published
    for path in published:
        policy = evaluate.load_policy(path)
        a = policy(np.zeros(OBS_DIM[policy.task], np.float32))
        assert a.shape == (4,) and np.abs(a).max() <= 1


class Object:
    """Not a plain type."""


BAD_POLICIES = {
    "missing": None,
    "text": b"not a policy\n",
    "pickled object": pickle.dumps(Object()),
    "object saved by torch": {"weights": Object()},
    "a tensor": torch.zeros(3),
    "a list": [1, 2],
    "no weights": {"task": "p2p", "symmetry": "none", "sizes": [22, 4], "output": "tanh"},
    "another task's observation": stored() | {"task": "pnp"},
    "other sizes": stored() | {"sizes": [22, 8, 4]},
    "weights of another kind": stored() | {"weights": [1.0]},
}


@pytest.mark.filterwarnings("error")  # a warning is a second line on standard error
@pytest.mark.parametrize("what", BAD_POLICIES)
def test_a_file_that_is_no_policy_is_refused_with_one_line_that_names_it(tmp_path, what):
    path, content = tmp_path / "policy.pt", BAD_POLICIES[what]
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(logx.BadInput) as refused:
        evaluate.load_policy(tmp_path)
    assert str(path) in str(refused.value) and "\n" not in str(refused.value)


def test_importing_evaluate_loads_neither_torch_nor_scipy():
    code = "import evaluate, sys; print({'torch', 'scipy', 'PIL', 'pandas'} & set(sys.modules))"
    root = Path(evaluate.__file__).parent
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


# ---- command line ----------------------------------------------------------------------------------------------------


@pytest.fixture
def main(monkeypatch):
    """main(*words): evaluate.py with this command line; the exit code."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # which main() sets

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["evaluate.py", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            logx.run_script(evaluate.main)
        return ended.value.code

    return call


def test_a_study_of_runs_prints_their_rows_and_writes_every_trial(run_folder, tmp_path, main, capsys):
    other = saved(tmp_path / "other", stored(seed=1))
    (run_folder / "evaluation.csv").write_text("of an earlier study")
    assert main(run_folder, "--versus", other / "policy.pt", "--trials", 3) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[1] == str(run_folder) and out[3].startswith("  3 trials: ") and out[4] == str(other / "policy.pt")
    assert out[8] == f"  minus {other / 'policy.pt'}, the same trials:"
    assert sorted(path.name for path in run_folder.iterdir()) == [
        "config.json", "evaluation.csv", "policy.pt", "trajectories.npz"]  # fmt: skip
    text = (run_folder / "evaluation.csv").read_bytes().decode()
    assert text.startswith(HEADER + "\n") and text.count("\n") == 4 and "\r" not in text
    rows, _ = evaluate.run_trials("p2p", run_folder, 3, quiet=True)
    for written, row in zip(csv.DictReader(text.splitlines()), rows, strict=True):
        assert written["failure"] == row.pop("failure")
        assert {name: float(written[name]) for name in row} == pytest.approx(row, rel=1e-5)
    assert (other / "evaluation.csv").read_text() != text


@pytest.mark.parametrize("words, what", [
    (["--start", "0.785", "0.52", "0.42", "--horizon", "9"], "-start_0.785_0.52_0.42-horizon_9"),
    (["--horizon", "400"], ""),  # T
    (["--horizon", "9", "--first_trial", "10000"], "-horizon_9-first_trial_10000"),
])  # fmt: skip
def test_other_settings_are_written_to_a_file_of_their_own(run_folder, main, words, what):
    assert main(run_folder, "--trials", 1, *words) == 0
    assert [path.name for path in run_folder.glob("*.csv")] == [f"evaluation{what}.csv"]
    assert (run_folder / "trajectories.npz").exists() == (not what)


def test_a_study_of_more_trials_is_not_replaced_by_one_of_fewer(run_folder, main, capsys):
    for trials in (2, 1, 3):
        assert main(run_folder, "--trials", trials) == 0
    assert "evaluation.csv: of 2 trials, stays as it is" in capsys.readouterr().out
    assert (run_folder / "evaluation.csv").read_text().count("\n") == 4


@pytest.mark.parametrize("words, says", [
    (["--pid", "--task", "p2p", "--gif", "a.gif", "--trials", 20], "--trials: does not go with --gif, --watch"),
    (["--list", "--task", "p2p"], "--task: does not go with --list"),
    (["--pid", "--task", "p2p", "--start", 0, -0.5, 0.45], "--start (0.0, -0.5, 0.45): rho must be at least 0"),
])  # fmt: skip
def test_a_flag_that_would_do_nothing_is_refused(main, capsys, words, says):
    assert main(*words) == 2 and says in capsys.readouterr().err


def test_trials_of_a_run_that_still_trains_are_printed_and_not_written(run_folder, main, capsys):
    with open(run_folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert main(run_folder, "--trials", 1) == 0 and "still trains" in capsys.readouterr().out
    assert not (run_folder / "evaluation.csv").exists()
    assert main(run_folder, "--trials", 1) == 0 and (run_folder / "evaluation.csv").exists()


def test_a_published_study_stays_as_it_is_and_another_one_is_written_beside_it(run_folder, main, capsys):
    (run_folder / "evaluation.csv.gz").write_bytes(b"as it was")
    assert main(run_folder, "--trials", 1) == 0 and "stays as it is" in capsys.readouterr().out
    assert sorted(path.name for path in run_folder.iterdir()) == [
        "config.json", "evaluation.csv.gz", "policy.pt"]  # fmt: skip
    assert main(run_folder, "--trials", 1, "--horizon", 9) == 0
    assert (run_folder / "evaluation-horizon_9.csv").exists()


def test_trials_of_the_demonstrator_are_printed_where_no_folder_is_given(tmp_path, main, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main("--pid", "--task", "p2p", "--gains", "fast", "--trials", 1) == 0
    assert capsys.readouterr().out.splitlines()[1] == "PID, fast gains, p2p" and not list(tmp_path.iterdir())


def test_trials_of_the_demonstrator_are_kept_where_a_folder_is_given(tmp_path, main, capsys):
    out = tmp_path / "new" / "pid-p2p-fast"
    assert main("--pid", "--task", "p2p", "--gains", "fast", "--trials", 2, "--out", out) == 0
    assert capsys.readouterr().out.splitlines()[1] == "PID, fast gains, p2p"
    config = json.loads((out / "config.json").read_text())
    assert (config["task"], config["algo"], config["gains"]) == ("p2p", "pid", "fast")
    assert (out / "evaluation.csv").read_text().count("\n") == 3
    with np.load(out / "trajectories.npz", allow_pickle=False) as kept:
        assert len(kept["length"]) == 2


def test_agents_are_filmed_side_by_side_on_the_trials_chosen(run_folder, tmp_path, main, monkeypatch):
    seeds, make_agent = [], evaluate.make_agent

    def small(task, source, **settings):
        env, act = make_agent(task, source, **(settings | {"width": 32, "height": 24}))
        reset = env.reset
        env.reset = lambda seed: seeds.append(seed) or reset(seed=seed)
        return env, act

    monkeypatch.setattr(evaluate, "make_agent", small)
    words = ["--pid", "--task", "p2p", "--gif", tmp_path / "both.gif", "--show", 4, 2, "--horizon", 5]
    assert main(run_folder, *words) == 0
    assert seeds == [1_000_004, 1_000_004, 1_000_002, 1_000_002]
    with Image.open(tmp_path / "both.gif") as image:
        assert image.n_frames > 1 and image.width == 2 * image.height * 4 // 3


def test_quick_runs_end_with_a_table_beside_the_demonstrator_the_trials_and_a_film(run_folder, monkeypatch, capsys):
    run_trials, filmed = evaluate.run_trials, []
    monkeypatch.setattr(evaluate, "run_trials", lambda task, source, n, quiet: run_trials(task, source, n // 50))
    monkeypatch.setattr(evaluate.film, "film", lambda agents, path, episodes, quiet: filmed.append((path, episodes)))
    evaluate.after_training(run_folder, "p2p", None, quiet=True)
    out = capsys.readouterr().out.splitlines()
    assert out[1] == str(run_folder) and out[4] == "PID, fast gains" and out[3].startswith("  2 trials")
    assert (run_folder / "evaluation.csv").read_text().count("\n") == 3
    assert filmed == [(run_folder / "agent.gif", {f"trial {i}": 1_000_000 + i for i in range(6)})]
    greater = (run_folder / "evaluation.csv").read_text() + "2,1\n"
    (run_folder / "evaluation.csv").write_text(greater)
    evaluate.after_training(run_folder, "p2p", None, quiet=True)
    assert (run_folder / "evaluation.csv").read_text() == greater


def test_the_list_names_each_trained_agent_with_its_success_and_the_command_that_watches_it(
    tmp_path, main, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("data/runs").mkdir(parents=True)
    own = saved(Path("data/runs/own"), stored())
    evaluate.write(own, [trial_row(1), trial_row(0)], {})
    assert main("--list") == 0
    out = capsys.readouterr().out.splitlines()
    shipped = Path(evaluate.__file__).parent.glob("data/results/*/policy.pt")
    python = os.path.relpath(sys.executable)
    for folder in (own, *(Path(os.path.relpath(path.parent)) for path in shipped)):
        assert f"    {python} evaluate.py {folder} --watch" in out
    assert out[out.index(f"    {python} evaluate.py {own} --watch") - 1] == "own - 50.0 % of 2 test trials"
    for content in ("trial\n0\n", "trial,success\n", "\0"):  # of another kind, of none, of none of ours
        (own / "evaluation.csv").write_text(content)
        assert main("--list") == 0 and "own - not tested" in capsys.readouterr().out


BAD = {
    "neither a run nor the PID": ([], "--pid"),
    "the PID without a task": (["--pid"], "--task"),
    "a task of a run": (["{run}", "--task", "p2p"], "--task"),
    "no trials": (["{run}", "--trials", "0"], "--trials"),
    "a run and an unknown folder": (["{run}", "{tmp}/nowhere"], "nowhere"),
    "a start out of reach": (["{run}", "--start", "0", "2", "0.4"], "--start"),
    "a GIF in no folder": (["{run}", "--gif", "{tmp}/nowhere/a.gif"], "--gif"),
    "a GIF named otherwise": (["{run}", "--gif", "{tmp}/a.png"], ".gif"),
    "two tasks compared": (["--pid", "--task", "pnp", "--versus", "{run}"], "--versus"),
    "a window for two": (["{run}", "--pid", "--task", "p2p", "--watch"], "--watch"),
    "a window without a display": (["{run}", "--watch"], "--watch"),
    "trials to show in no film": (["{run}", "--show", "1"], "--show"),
    "a film and a window": (["{run}", "--gif", "{tmp}/a.gif", "--watch"], "--gif"),
    "the trials' folder is a file": (["--pid", "--task", "p2p", "--out", "{run}/policy.pt"], "--out"),
    "the trials' folder is a run": (["--pid", "--task", "p2p", "--out", "{run}"], "--out"),
    "a run and itself": (["{run}", "--versus", "{run}"], "--versus"),
    "a folder that is a file": (["--pid", "--task", "p2p", "--trials", "1", "--out", "{run}/policy.pt/a"], "policy.pt"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_exit_code_2_and_one_line_that_names_it(what, run_folder, tmp_path, main, monkeypatch, capsys):
    argv, named = BAD[what]
    monkeypatch.delenv("DISPLAY", raising=False)
    before = sorted(tmp_path.rglob("*"))
    capsys.readouterr()
    assert main(*(word.format(run=run_folder, tmp=tmp_path) for word in argv)) == 2
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and named in err
    assert sorted(tmp_path.rglob("*")) == before
