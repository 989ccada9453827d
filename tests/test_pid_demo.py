"""pid_demo.py: the controller, the recorded arrays, the demonstration file, the command line."""

import json
import math
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from PIL import Image

import gas
import kinova_env
import logx
import pid_demo
from kinova_env import INDEX, OBS_DIM, TASKS, TIME_STEP, cartesian, postures, tcp, wrap
from pid_demo import EPISODES, GAINS, PID, ROWS, load_demos, record

PI = math.pi
STILL = (0.0, 0.0, 0.0)  # gains of a controller that never moves: every episode fails


def set_point(env, gain=0.1):
    """Joint set point of a P controller from its action: q + a / K_P, the gain small enough never to saturate."""
    return env.unwrapped.q + PID(env, (gain, 0.0, 0.0)).act().astype(float) / gain


# ---- the controller --------------------------------------------------------------------------------------------------


def test_set_point_is_the_posture_nearest_to_the_present_one_that_puts_the_tcp_at_the_goal(make):
    env = make(stage="test")
    for seed in range(20):
        env.reset(seed=seed)
        q, goal = np.array(env.unwrapped.q), env.unwrapped.goal
        target = set_point(env)
        assert math.dist(tcp(target), goal) < 1e-5
        ways = postures(goal) - q
        ways[:, 0] = wrap(ways[:, 0])
        assert np.linalg.norm(target - q) == pytest.approx(np.linalg.norm(ways, axis=1).min(), abs=1e-5)


def test_joint_1_turns_the_shortest_way_round(make):
    env = make()
    for start, goal in ((3.0, -3.0), (-3.0, 3.0), (-1.5, 1.5)):
        env.reset(seed=0, options={"start": (start, 0.52, 0.42), "goal": (goal, 0.52, 0.42)})
        way = set_point(env)[0] - env.unwrapped.q[0]
        assert abs(way) < PI
        assert way == pytest.approx(-wrap(goal - start), abs=1e-3)  # the axis points down


def test_action_is_proportional_integral_and_derivative_terms_of_the_joint_error(make):
    env = make()
    env.reset(seed=0, options={"start": (0.3, 0.52, 0.42), "goal": (0.7, 0.55, 0.46)})
    q = np.array(env.unwrapped.q)
    q_tilde = set_point(env) - q
    for K_P, K_D, K_I in ((0.4, 0.2, 0.0), (1.0, 0.2, 0.3), (0.0, 0.5, 0.0), (0.5, 0.0, 1.5)):
        pid, integral = PID(env, (K_P, K_D, K_I)), np.zeros(4)
        for shift, q_dot in ((0.0, (0.0,) * 4), (0.05, (0.5, -0.4, 0.3, 0.2)), (-0.1, (-0.1, 0.2, 0.0, 0.6))):
            env.unwrapped.q, env.unwrapped.q_dot = tuple(q + shift), q_dot
            integral += (q_tilde - shift) * TIME_STEP
            expected = K_P * (q_tilde - shift) + K_I * integral - K_D * np.array(q_dot)
            assert np.abs(expected).max() < 1
            np.testing.assert_allclose(pid.act(), expected, rtol=0, atol=2e-6)


def test_named_gains_are_designs_and_an_unknown_name_is_an_error(make):
    assert GAINS["authors"] == (0.4, 0.2, 0.0)
    assert GAINS["fast"][0] > GAINS["authors"][0]
    env = make()
    env.reset(seed=0)
    for name, gains in GAINS.items():
        assert np.array_equal(PID(env, name).act(), PID(env, gains).act())
    assert np.array_equal(PID(env).act(), PID(env, "authors").act())
    with pytest.raises(KeyError):
        PID(env, "quick")


def test_action_is_four_float32_within_one_whatever_the_gains(make):
    env = make("p2p")
    saturated = 0
    for gains in ((0.4, 0.2, 0.0), (1e6, 0.0, 0.0), (100.0, 10.0, 100.0)):
        pid = PID(env, gains)
        env.reset(seed=1)
        for _ in range(30):
            action = pid.act()
            assert action.dtype == np.float32 and action.shape == (4,) and action in env.action_space
            saturated += np.abs(action).max() == 1
            if env.step(action)[2]:
                break
    assert saturated > 10


def test_integral_grows_with_the_error_and_rests_while_the_action_is_saturated(make):
    env = make()
    env.reset(seed=0, options={"start": (0.0, 0.52, 0.42), "goal": (-1.0, 0.52, 0.42)})
    pid = PID(env, (0.4, 0.0, 5.0))
    first, second = pid.act()[0], pid.act()[0]
    assert second - first == pytest.approx(5.0 * 1.0 * TIME_STEP, abs=1e-3)  # K_I times the error of 1 rad times 20 ms
    for _ in range(500):  # 10 s in saturation; a wound-up integral would ask for 50 now
        assert pid.act()[0] <= 1
    assert pid.act()[0] == 1
    env.unwrapped.q = tuple(set_point(env) - (0.05, 0, 0, 0))
    assert 0.3 < pid.act()[0] < 0.9
    env.unwrapped.q = tuple(set_point(env) + (1.0, 0, 0, 0))
    assert pid.act()[0] < 0.3  # it turns round at once


def test_saturation_of_one_joint_does_not_stop_the_integral_of_another(make):
    env = make()
    env.reset(seed=0, options={"start": (0.0, 0.52, 0.42), "goal": (-1.5, 0.55, 0.42)})
    pid = PID(env, (1.0, 0.0, 1.0))
    actions = np.array([pid.act() for _ in range(10)])
    assert np.all(actions[:, 0] == 1)
    assert np.all(np.abs(actions[:, 1]) < 1)
    assert np.ptp(np.diff(actions[:, 1])) < 1e-6 and abs(actions[-1, 1] - actions[0, 1]) > 1e-3


def test_new_episode_has_its_own_set_point_and_an_empty_integral(make):
    env = make()
    pid = PID(env, (0.4, 0.1, 1.0))
    env.reset(seed=0, options={"goal": (-1.0, 0.5, 0.45)})
    for _ in range(50):
        env.step(pid.act())
    env.reset(seed=0, options={"goal": (1.6, 0.5, 0.45)})
    fresh = PID(env, (0.4, 0.1, 1.0))
    for _ in range(20):
        action = fresh.act()
        assert np.array_equal(pid.act(), action)
        env.step(action)


def test_wrapper_and_environment_are_controlled_alike(make):
    env = make()
    env.reset(seed=0)
    assert env.unwrapped is not env
    assert np.array_equal(PID(env).act(), PID(env.unwrapped).act())


def test_fast_gains_succeed_in_at_least_95_percent_and_in_fewer_steps_than_the_authors():
    fast, _ = record("p2p", 20, gains="fast", seed=0)
    authors, _ = record("p2p", 20, gains="authors", seed=0)
    assert fast["success"].mean() >= 0.95
    assert authors["success"].mean() >= 0.5
    both = fast["success"] & authors["success"]
    assert np.all(fast["length"][both] < authors["length"][both])
    assert fast["length"].mean() < 0.6 * authors["length"].mean()


@pytest.mark.parametrize("task", ["p2po", "pnp"])
def test_way_past_or_to_the_cube_depends_on_the_state_alone_not_on_what_was_reached_before(make, task):
    env = make(task, stage="test")
    pid, compared = PID(env, "fast"), 0
    rng = np.random.default_rng(0)
    for seed in range(4):
        env.reset(seed=seed)
        for _ in range(150):
            a = pid.act()
            if not env.unwrapped.grasped:
                assert np.array_equal(PID(env, "fast").act(), a)
                compared += 1
            if env.step(np.clip(a + 0.3 * rng.standard_normal(4), -1, 1).astype(np.float32))[2]:
                break
    assert compared > 200


def test_way_over_the_cube_rises_before_it_crosses_and_crosses_before_it_descends(make):
    env = make("p2po")
    start, goal, cube = (0.0, 0.52, 0.42), (-0.7, 0.5, 0.4), (-0.35, 0.5, 0.42)
    env.reset(seed=0, options={"start": start, "goal": goal, "object": cube})
    pid, path = PID(env, "fast"), []
    for _ in range(400):
        path.append(env.unwrapped.tcp)
        _, _, terminated, truncated, info = env.step(pid.act())
        if terminated or truncated:
            break
    assert info["is_success"]
    x, y, z = np.array(path).T
    over = np.hypot(x - env.unwrapped.cube[0], y - env.unwrapped.cube[1]) < 0.06
    assert over.any() and z[over].min() > 0.42 + 0.1
    risen = np.argmax(z > 0.42 + 0.1)
    assert abs(np.arctan2(y, x)[:risen]).max() < 0.3 * 0.7  # of the way round
    assert z.max() < 0.42 + 0.18 + 0.05 and z[-1] < 0.42 + 0.05


@pytest.mark.parametrize("stage, trials", [
    ("demo", (33, 104, 577, 805)), ("test", (4, 186, 371, 450, 720, 990)),  # where the cube is hard to get past
])  # fmt: skip
def test_way_over_the_cube_is_found_from_beside_it_and_to_goals_beside_it(make, stage, trials):
    env = make("p2po", stage=stage)
    pid = PID(env, "fast")
    for trial in trials:
        env.reset(seed=(1_010_000 if stage == "test" else 2_010_000) + trial)
        while True:
            _, _, terminated, truncated, info = env.step(pid.act())
            if terminated or truncated:
                break
        assert info["is_success"], trial


def test_arm_is_where_its_forward_kinematics_put_it():
    q = np.random.default_rng(0).uniform(-1, 1, (50, 4)) * (0, 2.4, 2.6, 2.2)
    r, z = pid_demo.arm(q[:, 1:])
    ends = np.array([tcp(one) for one in q])
    hand = np.stack([r[:, 3] - r[:, 2], z[:, 3] - z[:, 2]]) / (kinova_env.HAND + pid_demo.FINGERS)
    np.testing.assert_allclose(r[:, 3] - pid_demo.FINGERS * hand[0], ends[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(z[:, 3] - pid_demo.FINGERS * hand[1], ends[:, 2], rtol=0, atol=1e-12)


# ---- the recorded arrays ---------------------------------------------------------------------------------------------


def check_arrays(demos, task, episodes):
    """What holds of every set of demonstrations: columns, types, shapes, and that the rows fit together."""
    rows = len(demos["rew"])
    assert set(demos) - {"executed"} == (ROWS.keys() | EPISODES.keys()) - {"executed"}
    for name, column in demos.items():
        width = {"obs": (OBS_DIM[task],), "obs2": (OBS_DIM[task],), "act": (4,), "executed": (4,)}.get(name, ())
        assert column.dtype == np.dtype((ROWS | EPISODES)[name]), name
        assert column.shape == (rows if name in ROWS else episodes, *width), name
        assert np.all(np.isfinite(column))
    assert rows == demos["length"].sum() and np.all(demos["length"] > 0)
    assert np.array_equal(demos["episode"], np.repeat(np.arange(episodes), demos["length"]))
    assert np.abs(demos["act"]).max() <= 1
    end = np.cumsum(demos["length"]) - 1
    ended = demos["terminated"] | demos["truncated"]
    assert np.array_equal(np.flatnonzero(ended), end)
    inside = np.flatnonzero(~ended)
    assert np.array_equal(demos["obs2"][inside], demos["obs"][inside + 1])
    for last in end[:-1]:  # the next episode begins elsewhere
        assert not np.array_equal(demos["obs2"][last], demos["obs"][last + 1])
    for n in range(episodes):
        assert demos["return"][n] == pytest.approx(demos["rew"][demos["episode"] == n].sum(), abs=1e-9)
    assert np.array_equal(demos["success"], demos["terminated"][end] & (demos["rew"][end] > 5))


@pytest.mark.parametrize("task", TASKS)
def test_record_gives_whole_episodes_whose_rows_returns_and_ends_fit_together(task):
    demos, steps = record(task, 3, gains="fast", seed=2)
    check_arrays(demos, task, 3)
    assert steps == len(demos["rew"])


def test_recorded_rows_are_what_the_environment_returned(make):
    demos, _ = record("p2p", 2, gains="fast", seed=5)
    env = make(stage="demo")
    env.reset(seed=5)
    row = 0
    for n in range(2):
        s, info = env.reset()
        assert demos["partition"][n] == info["partition"]
        for _ in range(demos["length"][n]):
            s2, reward, terminated, truncated, _ = env.step(demos["act"][row])
            assert np.array_equal(demos["obs"][row], s) and np.array_equal(demos["obs2"][row], s2)
            assert (demos["rew"][row], demos["terminated"][row], demos["truncated"][row]) == (
                reward, terminated, truncated
            )  # fmt: skip
            s, row = s2, row + 1
    assert row == len(demos["rew"])


def test_recorded_actions_are_the_controllers():
    for gains in ("authors", "fast"):
        demos, _ = record("p2p", 1, gains=gains, seed=5)
        K_P, K_D, _ = GAINS[gains]
        goal = demos["obs"][0, INDEX["p2p"]["P_g"]].astype(float)
        first = demos["obs"][0, :4].astype(float)
        ways = postures(goal) - first
        ways[:, 0] = wrap(ways[:, 0])
        q_sp = first + ways[np.argmin(np.linalg.norm(ways, axis=1))]
        q_tilde = q_sp - demos["obs"][:, :4]
        q_tilde[:, 0] = wrap(q_tilde[:, 0])
        expected = np.clip(K_P * q_tilde - K_D * demos["obs"][:, INDEX["p2p"]["q_dot"]], -1, 1)
        np.testing.assert_allclose(demos["act"], expected, rtol=0, atol=2e-6)


def test_failed_episodes_are_kept_and_flagged():
    demos, steps = record("p2p", 3, gains=STILL, seed=0)
    check_arrays(demos, "p2p", 3)
    assert not demos["success"].any() and not demos["terminated"].any()
    assert demos["length"].tolist() == [400] * 3 and steps == 1200
    assert demos["truncated"].sum() == 3


def test_same_seed_records_the_same_demonstrations_and_another_seed_others():
    first, again, other = (record("p2p", 2, gains="fast", seed=seed)[0] for seed in (3, 3, 4))
    for name, column in first.items():
        assert column.tobytes() == again[name].tobytes()
    assert first["obs"].tobytes() != other["obs"].tobytes()


def test_partitions_are_drawn_from_all_K_and_each_episode_begins_in_its_own():
    for K in (3, 4):
        demos, _ = record("p2p", 16, gains="fast", seed=0, partitions=K)
        assert set(demos["partition"]) == set(range(K))
        begin = np.cumsum(demos["length"]) - demos["length"]
        assert np.array_equal(gas.partition_of(demos["obs"][begin], K), demos["partition"])


@pytest.mark.parametrize("task, N, K", [("p2p", 5, 4), ("p2po", 4, 3), ("p2p", 1, 8)])
def test_gas_takes_N_over_K_real_episodes_rounded_up_in_partition_0_and_maps_them_to_N(task, N, K):
    demos, steps = record(task, N, gains="fast", seed=0, partitions=K, symmetry="gas")
    check_arrays(demos, task, N)
    assert demos["partition"].tolist() == [n % K for n in range(N)]
    assert steps == demos["length"][::K].sum()  # the real ones
    assert len(demos["length"][::K]) == -(-N // K)
    begin = np.cumsum(demos["length"]) - demos["length"]
    assert np.array_equal(gas.partition_of(demos["obs"][begin], K), demos["partition"])
    for n in range(N):
        real = demos["episode"] == n - n % K
        image = demos["episode"] == n
        assert np.array_equal(demos["obs"][image], gas.phi(demos["obs"][real], n % K, K))
        assert np.array_equal(demos["rew"][image], demos["rew"][real])


@pytest.mark.parametrize("stage", ["train", "test"])
def test_other_stages_are_recorded_from_their_own_start_in_no_partition(stage):
    demos, _ = record("p2p", 2, gains="fast", seed=0, stage=stage)
    check_arrays(demos, "p2p", 2)
    assert demos["partition"].tolist() == [-1, -1]
    start = demos["obs"][0, INDEX["p2p"]["P_g"]] - demos["obs"][0, INDEX["p2p"]["e"]]
    theta, rho, z = {"train": (PI / 4, 0.52, 0.42), "test": (-PI / 4, 0.5, 0.45)}[stage]
    np.testing.assert_allclose(start, cartesian(theta, rho, z), rtol=0, atol=1e-6)


# ---- the demonstration file ------------------------------------------------------------------------------------------


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["pid_demo.py", *map(str, arguments)])
    return pid_demo.main()


@pytest.mark.parametrize("symmetry, K", [("none", 4), ("gas", 3)])
def test_recorded_file_read_back_is_what_record_gives_and_says_how_it_was_made(monkeypatch, tmp_path, symmetry, K):
    out = tmp_path / "demos.npz"
    arguments = ("--record", 4, "--out", out, "--gains", "fast", "--K_D", 0.25, "--seed", 6, "--partitions", K)
    run(monkeypatch, *arguments, "--symmetry", symmetry)
    assert list(tmp_path.iterdir()) == [out]  # nothing half-written stays
    demos, meta = load_demos(out, "p2p")
    expected, steps = record("p2p", 4, (1.0, 0.25, 0.0), seed=6, partitions=K, symmetry=symmetry)
    assert set(demos) == set(expected)
    for name, column in expected.items():
        assert demos[name].dtype == column.dtype and demos[name].tobytes() == column.tobytes()
    assert meta["task"] == "p2p" and meta["stage"] == "demo" and meta["env_steps"] == steps
    assert (meta["gains"], meta["seed"], meta["partitions"], meta["symmetry"]) == ([1.0, 0.25, 0.0], 6, K, symmetry)
    with np.load(out, allow_pickle=False) as file:
        assert set(file.files) == set(expected) | {"meta"}
        assert json.loads(str(file["meta"])) == meta


@pytest.mark.parametrize("task", TASKS)
def test_file_of_each_task_is_written_and_read_as_that_task_and_no_other(monkeypatch, tmp_path, task):
    out = tmp_path / "demos.npz"
    run(monkeypatch, "--task", task, "--record", 1, "--out", out, "--gains", "fast")
    demos, meta = load_demos(out, task)
    check_arrays(demos, task, 1)
    for other in set(TASKS) - {task}:
        with pytest.raises(ValueError, match=rf"{out}.*{task}, not {other}"):
            load_demos(out, other)


def test_record_replaces_an_older_file(monkeypatch, tmp_path):
    (out := tmp_path / "demos.npz").write_text("an older one")
    run(monkeypatch, "--record", 1, "--out", out, "--gains", "fast")
    assert len(load_demos(out, "p2p")[0]["length"]) == 1


@pytest.fixture(scope="module")
def good():
    demos, _ = record("p2p", 2, gains="fast", seed=0)
    return demos | {"meta": np.array(json.dumps({"task": "p2p", "symmetry": "none", "env_steps": 12, "partitions": 4}))}


def save(path, columns):
    with open(path, "wb") as file:
        np.savez_compressed(file, **columns)


def damaged(content):
    """300 bytes in the middle changed: more than a local header of the zip, so that data is hit."""
    middle = len(content) // 2
    return content[:middle] + bytes(byte ^ 0x55 for byte in content[middle : middle + 300]) + content[middle + 300 :]


BROKEN = {  # how a good file is spoilt
    "no file": lambda path, good: path.unlink(),
    "folder": lambda path, good: (path.unlink(), path.mkdir()),
    "text": lambda path, good: path.write_text("episode,return\n1,2\n"),
    "one array": lambda path, good: np.save(open(path, "wb"), good["obs"]),  # noqa: SIM115
    "cut short": lambda path, good: path.write_bytes(path.read_bytes()[:-1]),
    "damaged": lambda path, good: path.write_bytes(damaged(path.read_bytes())),
    "no truncated": lambda path, good: save(path, {key: good[key] for key in good if key != "truncated"}),
    "no meta": lambda path, good: save(path, {key: good[key] for key in good if key != "meta"}),
    "rew too short": lambda path, good: save(path, good | {"rew": good["rew"][:-1]}),
    "return too short": lambda path, good: save(path, good | {"return": good["return"][:-1]}),
    "obs too narrow": lambda path, good: save(path, good | {"obs": good["obs"][:, :-1]}),
    "obs words": lambda path, good: save(path, good | {"obs": good["obs"].astype(str)}),
    "act not finite": lambda path, good: save(path, good | {"act": good["act"] * np.nan}),
    "act above 1": lambda path, good: save(path, good | {"act": good["act"] * 50}),
    "episodes from 1": lambda path, good: save(path, good | {"episode": good["episode"] + 1}),
    "no end": lambda path, good: save(path, good | {end: good[end] & False for end in ("terminated", "truncated")}),
    "an end amid an episode": lambda path, good: save(path, good | {"truncated": good["truncated"] | True}),
    "angles in degrees": lambda path, good: save(path, good | {"obs": good["obs"] * ([57.3] * 4 + [1] * 18)}),
    "no such partition": lambda path, good: save(path, good | {"partition": good["partition"] + 4}),
    "meta not JSON": lambda path, good: save(path, good | {"meta": np.array("{")}),
    "meta without a task": lambda path, good: save(path, good | {"meta": np.array("{}")}),
    "of an unknown task": lambda path, good: save(path, good | {"meta": np.array('{"task": "fly"}')}),
    "no episode": lambda path, good: save(path, {key: good[key][:0] if good[key].ndim else good[key] for key in good}),
    "meta a list": lambda path, good: save(path, good | {"meta": np.array('["p2p"]')}),
}


@pytest.mark.parametrize("how", BROKEN)
def test_file_that_is_not_whole_demonstrations_is_a_value_error_that_names_it(tmp_path, good, how):
    path = tmp_path / "demos.npz"
    save(path, good | {"note": np.array("what a file holds beside is left out")})
    assert set(load_demos(path, "p2p")[0]) == set(good) - {"meta"}
    BROKEN[how](path, good)
    with pytest.raises(ValueError) as error:
        load_demos(path, "p2p")
    assert str(path) in str(error.value)


def test_pickled_file_is_never_unpickled(tmp_path, good):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    path = tmp_path / "demos.npz"
    save(path, good | {"obs": np.array([Trap()], dtype=object)})
    with pytest.raises(ValueError, match="demos.npz"):
        load_demos(path, "p2p")
    assert not (tmp_path / "sprung").exists()


# ---- the command line ------------------------------------------------------------------------------------------------

BAD = [  # arguments ({} is an empty folder), what the line names
    ("", "--record, --trials, --watch, --gif, --inspect"),
    ("--gif {}/x.gif --noise 0.2", "--noise: does not go with --gif"),
    ("--trials 1 --symmetry gas", "--symmetry: does not go with --trials"),
    ("--trials 1 --clearance 0.1", "--clearance: does not go with --task p2p"),
    ("--trials 1 --stage test --partitions 3", "--partitions: does not go with --stage test"),
    ("--inspect {}/x.npz --seed 1", "--seed: does not go with --inspect"),
    ("--trials 1 --partitions 101", "--partitions 101"),
    ("--trials 99999999999999999999", "--trials 9"),
    ("--trials 1 --gif {}/x.gif", "--trials --gif"),
    ("--record 1", "--out"),
    ("--trials 1 --out {}/x.npz", "--out"),
    ("--record 0 --out {}/x.npz", "--record 0"),
    ("--record 1 --out {}", "--out"),
    ("--gif {}/none/x.gif", "none/x.gif"),
    ("--gif {}/x.png", ".gif or .mp4"),
    ("--trials 1 --K_D nan", "--K_D nan"),
    ("--record 1 --out {}/x.npz --symmetry gas --stage test", "--stage"),
    ("--trials 1 --partitions 40 --task pnp", "--partitions 40"),
    ("--watch", "--watch: needs a display"),
    ("--inspect {}/none.npz", "none.npz: no such file"),
    ("--trials 1 --minari kinova/p2p/fast-v0", "--minari"),
]


@pytest.mark.parametrize("line, named", BAD)
def test_bad_input_names_the_flag_and_leaves_nothing(monkeypatch, tmp_path, line, named):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(logx.BadInput) as error:
        run(monkeypatch, *line.format(tmp_path).split())
    assert named in str(error.value) and list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_written_is_bad_input_and_leaves_nothing(monkeypatch, tmp_path):
    def no_room(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(logx.os, "replace", no_room)
    with pytest.raises(logx.BadInput, match=r"x.npz: cannot be written \(No space left on device\)"):
        run(monkeypatch, "--record", 1, "--out", tmp_path / "x.npz", "--gains", "fast")
    assert not list(tmp_path.iterdir())


def test_trials_print_success_length_return_and_effort_and_write_nothing(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    run(monkeypatch, "--trials", 3, "--gains", "fast", "--stage", "test", "--seed", 2)
    out = capsys.readouterr().out
    demos, steps = record("p2p", 3, "fast", seed=2, stage="test")
    assert "3 episodes" in out and f"{steps} environment steps" in out
    assert f"success {100 * demos['success'].mean():.1f} %" in out
    assert f"{demos['length'][demos['success']].mean():.0f} steps" in out
    assert f"return {demos['return'].mean():.2f}" in out
    effort = float(out.split("effort ")[1].split("%")[0])
    assert 0 < effort < 100  # T_eff: 100 times the mean norm of tau_hat, over its largest possible value of 2
    under_way = demos["rew"] < 5
    terms = demos["rew"][under_way] + 2e-3 * np.linalg.norm(demos["obs2"][under_way, INDEX["p2p"]["e"]], axis=1)
    assert effort == pytest.approx(-terms.mean() / 1e-3 * 50, rel=0.1)
    assert list(tmp_path.iterdir()) == []


def test_inspect_prints_what_a_file_holds_by_partition(monkeypatch, tmp_path, capsys):
    out = tmp_path / "demos.npz"
    run(monkeypatch, "--record", 9, "--gains", "fast", "--out", out)
    demos, meta = load_demos(out)
    capsys.readouterr()
    run(monkeypatch, "--inspect", out)
    first, _, *rows = capsys.readouterr().out.splitlines()
    assert str(out) in first and f"p2p, recorded in {meta['env_steps']:,} steps" in first
    rows = {row.split()[0]: row.split() for row in rows}
    assert set(rows) == {"all", *map(str, set(demos["partition"]))}
    for name, row in rows.items():
        of = demos["partition"] == int(name) if name != "all" else slice(None)
        assert int(row[1]) == len(demos["success"][of]) and float(row[2]) == 100
        assert float(row[-2]) == pytest.approx(demos["return"][of].mean(), abs=0.006)
        assert (row[4], row[5]) == (f"[{demos['length'][of].min()},", f"{demos['length'][of].max()}]")


@pytest.mark.extras
@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_minari_dataset_holds_the_same_demonstrations_and_leads_back_to_the_environment(
    monkeypatch, tmp_path, capsys, noise
):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    out, name = tmp_path / "demos.npz", "kinova/p2p/fast-v0"
    arguments = ["--record", 3, "--gains", "fast", "--noise", noise, "--minari", name]
    run(monkeypatch, *arguments, "--out", out)
    (ours, meta), (theirs, their_meta) = load_demos(out), load_demos(f"minari:{name}")
    assert meta == their_meta and set(ours) == set(theirs) and ("executed" in ours) == (noise > 0)
    for key in ours:
        assert ours[key].dtype == theirs[key].dtype
        np.testing.assert_array_equal(ours[key], theirs[key])
    dataset = minari.load_dataset(name)
    assert dataset.recover_environment(stage="demo").unwrapped.task == "p2p"
    np.testing.assert_array_equal(dataset[0].actions, ours.get("executed", ours["act"])[: ours["length"][0]])
    with pytest.raises(logx.BadInput, match=f"--minari {name}: there is one already"):
        run(monkeypatch, *arguments)
    with pytest.raises(logx.BadInput, match="--minari fast: must be a Minari name"):
        run(monkeypatch, *arguments[:-1], "fast")
    with pytest.raises(ValueError, match="minari:none-v0: no such dataset"):
        load_demos("minari:none-v0")


@pytest.mark.extras
def test_a_minari_dataset_that_others_recorded_is_read_as_demonstrations(monkeypatch, tmp_path):
    import minari
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    demos, steps = record("p2p", 2, "fast", stage="train")
    first = demos["length"][0]
    episode = EpisodeBuffer(
        observations=np.vstack((demos["obs"][:first], demos["obs2"][first - 1])), actions=demos["act"][:first],
        rewards=demos["rew"][:first], terminations=demos["terminated"][:first],
        truncations=demos["truncated"][:first])  # fmt: skip
    minari.create_dataset_from_buffers("others/reach-v0", [episode], env=gymnasium.spec("KinovaP2P-v0"))
    found, meta = load_demos("minari:others/reach-v0", "p2p")
    for key in ROWS.keys() - {"executed"}:
        np.testing.assert_array_equal(found[key], demos[key][:first])
    assert found["success"] == [True] and found["return"] == demos["return"][0] and meta["env_steps"] == first
    assert found["partition"] == [1]  # where the start, pi/4, lies: sectors are centred on -pi/4, pi/4, ...


def test_trials_without_a_success_say_so(monkeypatch, capsys):
    run(monkeypatch, "--trials", 1, "--K_P", 0)
    out = capsys.readouterr().out
    assert "success 0.0 %" in out and "nan" not in out


def test_command_line_records_and_exits_0_and_says_what_is_wrong_with_2(tmp_path):
    """The same through a real process: no traceback, and not even PyBullet's greeting on standard error."""
    script, out = Path(pid_demo.__file__), tmp_path / "demos.npz"
    arguments = [sys.executable, script, "--record", "1", "--out", out, "--gains", "fast"]
    done = subprocess.run(arguments, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(out) in done.stdout and len(load_demos(out, "p2p")[0]["length"]) == 1
    done = subprocess.run([*arguments, "--K_P", "nan"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1) and "--K_P" in done.stderr


# ---- pictures --------------------------------------------------------------------------------------------------------


def test_gif_option_films_the_pid_on_the_task_asked(monkeypatch, tmp_path, capsys):
    path = tmp_path / "arm.gif"
    whole, make, made = pid_demo.film.film, gymnasium.make, []

    def short_make(id_, **settings):  # twelve small frames instead of hundreds
        made.append((id_, settings["render_mode"], settings["stage"]))
        return make(id_, **(settings | {"width": 32, "height": 24, "max_episode_steps": 5}))

    monkeypatch.setattr(gymnasium, "make", short_make)
    monkeypatch.setattr(pid_demo.film, "film", lambda agents, out, _: whole(agents, out, {"episode 0": 0}))
    run(monkeypatch, "--task", "pnp", "--gif", path, "--gains", "fast", "--stage", "train")
    assert made == [(TASKS["pnp"].env_id, "rgb_array", "train")]
    assert str(path) in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [path]
    with Image.open(path) as image:
        assert image.n_frames > 1
