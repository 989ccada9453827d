"""kinova_env.py: the class docstring against the code, the start of an episode, reward and end, one process."""

import functools
import math
import sys
import warnings

import gymnasium
import numpy as np
import pybullet
import pytest
from gymnasium.utils.env_checker import check_env

import kinova_env
from kinova_env import INDEX, OBSERVATION, TASKS, KinovaEnv, cartesian, postures, start_posture, tcp, wrap

PI = math.pi
CUBES = [task for task in TASKS if TASKS[task].cube]
ZERO = np.zeros(4, dtype=np.float32)
FAR = {"start": (0.3, 0.52, 0.42), "goal": (1.6, 0.5, 0.4)}  # nothing happens near the start
FOLD = np.array([0.7, 1.0, -1.0, -1.0], dtype=np.float32)  # folds the gripper into the base
TURN = np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32)


def far(task, **options):
    """Explicit options of an episode in which nothing happens near the start."""
    return FAR | ({"object": (2.2, 0.5, 0.45)} if TASKS[task].cube else {}) | options


def part(obs, name):
    """The entries of an observation, of any task, that the paper's state calls `name`."""
    return obs[..., INDEX["pnp"][name]].astype(float)


def cylinder(position):
    return math.atan2(position[1], position[0]), math.hypot(position[0], position[1]), position[2]


def rollout(env, actions, **reset):
    """[(obs, reward, terminated, truncated, info)] of an episode; the reset's row first."""
    obs, info = env.reset(**reset)
    rows = [(obs, 0.0, False, False, info)]
    for action in actions:
        rows.append(env.step(action))
        if rows[-1][2] or rows[-1][3]:
            break
    return rows


def random_actions(seed, steps=200):
    """Random actions, each held for ten steps, so that the arm gets somewhere."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps // 10, 4)).astype(np.float32).repeat(10, axis=0)


def assert_same_bits(rows, others):
    assert len(rows) == len(others)
    for (obs, *rest), (other, *other_rest) in zip(rows, others, strict=True):
        assert obs.tobytes() == other.tobytes()
        assert rest == other_rest


# ---- arguments -------------------------------------------------------------------------------------------------------


def test_wrong_argument_is_a_value_error_that_names_it():
    wrong = {"task": "reach", "stage": "Train", "partitions": 2.5, "width": -5, "height": True, "render_mode": "ansi"}
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=f"{name} {value!r}: must be"):
            KinovaEnv(**{name: value})


def test_window_without_a_display_is_a_value_error_that_says_so(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(ValueError, match="render_mode 'human'.*needs a display"):
        KinovaEnv(render_mode="human")


@pytest.mark.parametrize("task, stage, options, named", [
    ("p2p", "train", {"start": (0, 0.35, 0.25)}, "start .*0.35"),  # in reach, but not with a horizontal tool
    ("p2p", "train", {"goal": (0, 1.5, 0.42)}, "goal .*1.5"),
    ("p2po", "train", {"object": (0, 0.5, 1.5)}, "object .*1.5"),
    ("pnp", "train", {"object": (0, 0.35, 0.25)}, "object .*0.35"),  # in reach, but with no level hand
    ("pnp", "train", {"goal": (0, 0.1, 1.25)}, "goal .*1.25.*cubes"),  # in reach, and no cube beside it is
    ("pnp", "train", {"object": (0, -0.5, 0.4)}, "object .*rho >= 0"),
    ("p2p", "train", {"start": "abc"}, "start 'abc'"),
    ("p2p", "train", {"goal": (0, 0.5)}, "goal .*three"),
    ("p2p", "train", {"goal": (0, math.nan, 0.4)}, "goal .*nan"),
    ("p2p", "train", {"object": (0, 0.5, 0.42)}, "object"),
    ("p2p", "train", {"gaol": (0, 0.5, 0.42)}, "gaol"),
    ("p2p", "test", {"partition": 0}, "partition.*test"),
    ("p2p", "demo", {"partition": 4}, "partition 4"),
])  # fmt: skip
def test_wrong_or_unreachable_option_is_a_value_error_that_names_it(make, task, stage, options, named):
    env = make(task, stage=stage)
    with pytest.raises(ValueError, match=named):
        env.reset(seed=0, options=options)


@pytest.mark.parametrize("task, stage, options", [
    ("p2p", "train", {"goal": (PI / 4, 0.52, 0.42)}),  # at the start, which is not drawn on this stage
    ("p2po", "train", {"start": (0, 0.5, 0.42), "goal": (0, 0.5, 0.42)}),
    ("p2po", "train", {"object": (PI / 4, 0.45, 0.42)}),  # in the palm
    ("pnp", "train", {"goal": (0, 0.35, 0.25)}),  # where no start and no cube may be
    ("pnp", "demo", {"partition": 0, "object": (2.0, 0.5, 0.42)}),  # outside the sector
])  # fmt: skip
def test_explicit_options_that_no_draw_would_give_begin_an_episode(make, task, stage, options):
    env = make(task, stage=stage)
    obs, _ = env.reset(seed=0, options=options)
    named = {"goal": part(obs, "P_g"), "object": part(obs, "P_o"), "start": part(obs, "P_g") - part(obs, "e")}
    for name in set(options) - {"partition"}:
        np.testing.assert_allclose(named[name], cartesian(*options[name]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("action", [[0, 0, math.nan, 0], [0, 0, 0], [[0, 0, 0, 0]], [[0], [0], [0], [0]], 0, ["0"] * 4])
def test_what_is_no_action_is_a_value_error(make, action):
    env = make("p2p")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="must be 4 numbers"):
        env.step(np.array(action))


# ---- the class docstring against the code ----------------------------------------------------------------------------


def tables(text):
    """The rows of each table of a docstring by the section it stands in, without the header."""
    found, section = {}, None
    for line in (line.strip() for line in text.splitlines()):
        if line.startswith("## "):
            section = line[3:]
        elif line.startswith("|"):
            found.setdefault(section, []).append([cell.strip() for cell in line.strip("|").split("|")])
    return {section: rows[2:] for section, rows in found.items()}


DOC = tables(KinovaEnv.__doc__)


def test_action_table_of_the_docstring_is_the_action_space(make, arm):
    space = make("p2p").action_space
    assert space == gymnasium.spaces.Box(-1, 1, (4,), np.float32)
    assert [int(row[0]) for row in DOC["Action space"]] == [0, 1, 2, 3]
    joints = [pybullet.getJointInfo(arm.body, j, physicsClientId=arm.client) for j in kinova_env.ACTIVE_JOINTS]
    _, names, speeds, torques = zip(*DOC["Action space"], strict=True)
    assert list(names) == [joint[1].decode() for joint in joints]
    assert (tuple(map(float, speeds)), tuple(map(float, torques))) == (kinova_env.VELOCITY_MAX, kinova_env.TAU_MAX)


@pytest.mark.parametrize("task, speed", [("p2p", 0.5), ("p2po", 1.0), ("pnp", 1.0)])
def test_action_one_is_the_joint_velocity_of_the_docstring_times_the_tasks_speed(make, task, speed):
    for joint, action in enumerate(np.eye(4, dtype=np.float32)):
        obs, *_ = rollout(make(task), [action] * 12, seed=0, options=far(task))[-1]
        expected = float(DOC["Action space"][joint][2]) * speed * action
        np.testing.assert_allclose(part(obs, "q_dot"), expected, rtol=0, atol=5e-3)


def test_actions_beyond_one_are_clipped(make):
    beyond = rollout(make("p2p"), [1e6 * (TURN - FOLD)] * 15, options=far("p2p"))
    assert_same_bits(beyond, rollout(make("p2p"), [np.sign(TURN - FOLD)] * 15, options=far("p2p")))


@pytest.mark.parametrize("task, width", [("p2p", 22), ("p2po", 25), ("pnp", 25)])
def test_observation_table_of_the_docstring_is_the_layout_its_index_and_the_space(make, task, width):
    rows = DOC["Observation space"] if width == 25 else DOC["Observation space"][:-1]
    index, high = {}, []
    for indices, name, _, bound, _ in rows:
        first, last = (int(i) for i in indices.split("-"))
        assert first == len(high)
        index[name] = slice(first, last + 1)
        high += [PI if bound == "pi" else float(bound)] * (last + 1 - first)
    assert INDEX[task] == index and kinova_env.OBS_DIM[task] == width == len(high)
    assert [(name, w) for name, w, _ in OBSERVATION[task]] == [(name, s.stop - s.start) for name, s in index.items()]
    assert make(task).observation_space == gymnasium.spaces.Box(-np.float32(high), np.float32(high))


def test_reward_table_of_the_docstring_is_that_of_the_module(make):
    terms = dict(DOC["Rewards"])
    assert list(terms) == list(make("p2p").reset(seed=0)[1]["reward_terms"])
    assert [float(text.split()[0]) for text in terms.values()] == [-2e-3, -1e-3, 10, -2, 2]  # the paper's, Sec. 4.2
    assert (kinova_env.ALPHA_1, kinova_env.ALPHA_2, kinova_env.EPSILON) == (2e-3, 1e-3, 0.05)
    assert (kinova_env.R_1, kinova_env.R_2, kinova_env.R_3) == (10, 2, 2)


@pytest.mark.parametrize("task, horizon", [("p2p", 400), ("p2po", 500), ("pnp", 800)])
def test_the_registered_horizon_is_the_papers(make, task, horizon):
    assert gymnasium.spec(TASKS[task].env_id).max_episode_steps == TASKS[task].horizon == horizon
    assert str(horizon) in KinovaEnv.__doc__.split("## Episode end")[1]


# ---- start of an episode ---------------------------------------------------------------------------------------------


@functools.cache
def draws(task, stage, K=4, count=300):
    """Observations (count, width) and partitions (-1: none) of so many resets, the first seeded."""
    env = KinovaEnv(task, stage, K)
    results = [env.reset(seed=3 if n == 0 else None) for n in range(count)]
    env.close()
    return np.array([obs for obs, _ in results]), np.array([info.get("partition", -1) for _, info in results])


def assert_fills(values, low, high):
    """Values are uniform-looking in [low, high): all inside, both ends nearly reached, the middle in the middle."""
    values, margin = np.asarray(values), 0.05 * (high - low)
    assert values.min() >= low - 1e-6 and values.max() < high + 1e-6
    assert values.min() < low + margin and values.max() > high - margin
    assert np.mean(values) == pytest.approx((low + high) / 2, abs=0.1 * (high - low))


@pytest.mark.parametrize("task, stage", [("p2p", "train"), ("p2p", "test"), ("p2po", "test"), ("pnp", "train")])
def test_start_and_goal_of_train_and_test_episodes_follow_the_table(task, stage):
    obs, partitions = draws(task, stage)
    theta = {"train": PI / 4, "test": -PI / 4 if task == "p2p" else -PI / 2}[stage]
    start = (theta, 0.52, 0.42) if stage == "train" else (theta, 0.5, 0.45)
    np.testing.assert_allclose(part(obs, "q"), np.tile(start_posture(*start), (len(obs), 1)), rtol=0, atol=1e-6)
    goals = np.array([cylinder(goal) for goal in part(obs, "P_g")])
    for column, (low, high) in zip(goals.T, [(-PI, PI), (0.3, 0.7), (0.25, 0.65)], strict=True):  # Eq. 10
        assert_fills(column, low, high)
    assert set(partitions) == {-1}  # only demonstrations have one
    rows = {row[0]: row[1:] for row in DOC["Starting state"]}
    assert (rows["train"][1], rows["test"][1]) == ("[-pi, pi), [0.3, 0.7), [0.25, 0.65)", "as train")
    assert rows[stage][0] == {"train": "pi/4, 0.52, 0.42", "test": "-pi/4 (P2P) or -pi/2, 0.5, 0.45"}[stage]


@pytest.mark.parametrize("task, K", [("p2p", 4), ("p2po", 3), ("pnp", 4)])
def test_start_and_goal_of_demonstrations_follow_the_table_for_every_number_of_partitions(task, K):
    obs, partitions = draws(task, "demo", K)
    assert np.bincount(partitions, minlength=K).min() > len(obs) / K * 0.7 and partitions.max() < K  # uniform
    centre = (partitions - (0.5 if task == "p2p" else 0)) * 2 * PI / K
    mean = np.array([start_posture(theta, 0.52, 0.42) for theta in centre])
    jitter = wrap(part(obs, "q") - mean).T
    assert_fills(jitter, -0.02, 0.02)
    assert np.abs(np.corrcoef(jitter) - np.eye(4)).max() < 0.3  # each joint by itself
    goals = np.array([cylinder(goal) for goal in part(obs, "P_g")])
    assert_fills(wrap(goals[:, 0] - centre), -PI / K, PI / K if task == "p2p" else 0)
    assert_fills(goals[:, 1], 0.4, 0.6)
    assert_fills(goals[:, 2], 0.35, 0.55)
    start, goal = DOC["Starting state"][-1][1:]
    assert start.endswith("0.52, 0.42, each joint +- 0.02 rad") and goal == "in the sector, [0.4, 0.6), [0.35, 0.55)"


@pytest.mark.parametrize("task, stage", [("p2po", "train"), ("p2po", "demo"), ("pnp", "test"), ("pnp", "demo")])
def test_cube_lies_beside_the_goal_as_the_table_says(task, stage):
    obs, partitions = draws(task, stage)
    goals, cubes = ([cylinder(place) for place in part(obs, name)] for name in ("P_g", "P_o"))
    theta, rho, z = (np.array(cubes) - goals).T
    theta, rho = wrap(theta), np.array(cubes)[:, 1]
    assert_fills(np.abs(theta), PI / 12, PI / 6)
    assert min(np.mean(theta > 0), np.mean(theta < 0)) > 0.1  # both sides
    assert rho.min() >= 0.4 - 1e-6 and rho.max() < 0.6
    assert z.min() >= -0.1 - 1e-6 and z.max() < 0.1 + 1e-6 and np.ptp(z) > 0.18 and np.ptp(rho) > 0.18
    if task == "pnp" and stage == "demo":  # such cubes are drawn again until they lie in the sector
        assert np.abs(wrap(np.array(cubes)[:, 0] - partitions * PI / 2)).max() <= PI / 4 + 1e-6


@pytest.mark.parametrize("task", TASKS)
def test_sampled_episode_never_begins_at_the_goal_or_in_collision(arm, task):
    id_ = {"physicsClientId": arm.client}
    pybullet.setCollisionFilterPair(arm.body, arm.body, 4, 6, 0, **id_)  # held together by Actuator6
    box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.02] * 3, **id_)
    cube = pybullet.createMultiBody(0, box, **id_) if task in CUBES else None
    obs, _ = draws(task, "demo", count=500)
    assert np.linalg.norm(part(obs, "e"), axis=1).min() >= 0.05
    for row in obs:
        arm.pose(part(row, "q"))
        if task in CUBES:
            turn = pybullet.getQuaternionFromEuler([0, 0, cylinder(part(row, "P_o"))[0]])
            pybullet.resetBasePositionAndOrientation(cube, part(row, "P_o"), turn, **id_)
        pybullet.performCollisionDetection(**id_)
        assert not pybullet.getContactPoints(arm.body, arm.body, **id_)
        touching = pybullet.getClosestPoints(arm.body, cube, 0.0, **id_) if task in CUBES else ()
        assert not [contact for contact in touching if task == "p2po" or contact[3] != 6]


def test_pick_and_place_cubes_can_be_grasped_and_goals_are_uniform_however_few_cubes_can():
    """The cube alone is drawn again: drawing the goal too would leave 18 % of the goals in the lowest quarter."""
    obs, _ = draws("pnp", "train", count=1500)
    assert np.mean(part(obs, "P_g")[:, 2] < 0.35) == pytest.approx(0.25, abs=0.034)  # three standard deviations
    for cube in part(obs, "P_o")[:300]:  # an approach within epsilon_q of the horizontal
        assert len(postures(cube, np.linspace(-0.3, 0.3, 61)))


# ---- observation, reward, end ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_gymnasiums_checker_finds_nothing_to_warn_of(task):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for settings in ({}, {"render_mode": "rgb_array", "width": 32, "height": 24}, {"stage": "demo"}):
            env = gymnasium.make(TASKS[task].env_id, **settings)
            check_env(env.unwrapped, skip_render_check=True)  # which opens a window
            env.reset(seed=0)
            env.step(env.action_space.sample())
            env.close()


@pytest.mark.parametrize("task", TASKS)
def test_observation_is_posture_sines_cosines_velocities_goal_and_goal_minus_tcp(make, arm, task):
    env = make(task)
    # several turns of joint 1, so that its angle has to be wrapped
    rows = rollout(env, [TURN + 0.3 * action for action in random_actions(0, 450)], seed=0, options=far(task))
    seen = np.array([obs for obs, *_ in rows])
    assert seen.dtype == np.float32 and all(obs in env.observation_space for obs in seen)
    q = part(seen, "q")
    assert np.abs(np.diff(q[:, 0])).max() > 6, "joint 1 never passes pi"
    assert not any(row[3] for row in rows[:-1])  # only demonstrations have a sector to leave
    assert np.all((q[:, 0] >= np.float32(-PI)) & (q[:, 0] <= np.float32(PI)))
    np.testing.assert_allclose(part(seen, "sin q"), np.sin(q), rtol=0, atol=3e-7)
    np.testing.assert_allclose(part(seen, "cos q"), np.cos(q), rtol=0, atol=3e-7)
    np.testing.assert_allclose(part(seen, "e"), part(seen, "P_g") - [tcp(one) for one in q], rtol=0, atol=1e-6)
    np.testing.assert_allclose(part(seen, "P_g"), np.tile(cartesian(*FAR["goal"]), (len(seen), 1)), rtol=0, atol=1e-7)
    np.testing.assert_allclose(wrap(np.diff(q, axis=0)), part(seen, "q_dot")[1:] / 50, rtol=0, atol=1e-6)
    assert not part(seen, "q_dot")[0].any()


@pytest.mark.parametrize("task", TASKS)
def test_reward_is_the_sum_of_its_terms_and_each_follows_its_formula(make, task):
    ends = set()
    for seed, actions in ((0, random_actions(0, 150)), (1, [FOLD] * 150), (2, random_actions(2, 150))):
        for obs, reward, terminated, _, info in rollout(make(task), actions, seed=seed, options=far(task))[1:]:
            terms = info["reward_terms"]
            assert list(terms) == ["distance", "effort", "reaching", "collision", "grasping"]
            assert reward == pytest.approx(sum(terms.values()), abs=1e-12)
            e = part(obs, "e")
            to_go = part(obs, "P_o") - (part(obs, "P_g") - e) if task == "pnp" and not info["grasped"] else e
            assert info["distance"] == pytest.approx(np.linalg.norm(e), abs=1e-6)
            assert terms["distance"] == pytest.approx(-0.002 * np.linalg.norm(to_go), abs=1e-8)
            assert terms["effort"] == pytest.approx(-0.001 * info["effort"], abs=1e-12)
            assert terms["reaching"] == (10 if info["is_success"] else 0)
            assert terms["collision"] == (-2 if info["collision"] else 0)
            assert terminated == (info["is_success"] or info["collision"] != "")
            ends.add(info["collision"])
    assert "self" in ends


@pytest.mark.parametrize("task, action, start", [
    ("p2p", (0, 0, 0, 0), (0.3, 0.52, 0.42)), ("p2po", (1, 0, 0, 0), (2.0, 0.4, 0.6)),
    ("pnp", (1, 0.3, 0.3, -0.5), (0.3, 0.52, 0.42)),
])  # fmt: skip
def test_effort_is_the_inverse_dynamics_of_the_motion_under_gravity_with_no_friction(make, arm, task, action, start):
    """tau_hat = |motor torque| / limit, against PyBullet's inverse dynamics of the same step at 9.81 m/s^2."""
    theta = start[0]
    options = {"start": start, "goal": (theta + 3, 0.5, 0.45)}
    options |= {"object": (theta + 2.5, 0.5, 0.45)} if task in CUBES else {}
    *_, before, last = rollout(make(task), [np.float32(action)] * 20, seed=0, options=options)
    q, v0, v = (part(obs, name).tolist() for obs, name in ((before[0], "q"), (before[0], "q_dot"), (last[0], "q_dot")))
    acceleration = [(b - a) * 50 for a, b in zip(v0, v, strict=True)]
    torque = pybullet.calculateInverseDynamics(arm.body, q, v, acceleration, physicsClientId=arm.client)
    assert last[4]["effort"] == pytest.approx(np.linalg.norm(np.divide(torque, (39, 39, 39, 9))), abs=1e-5)


@pytest.mark.parametrize("task", ["p2p", "p2po"])
def test_success_is_an_error_below_five_centimetres_and_ends_the_episode_with_ten(make, task):
    start = (0.0, 0.52, 0.42)
    rows = rollout(make(task), [-TURN] * 100, seed=0, options=far(task, start=start, goal=(0.5, 0.52, 0.42)))[1:]
    distances = [np.linalg.norm(part(obs, "e")) for obs, *_ in rows]
    assert distances[-1] < 0.05 and min(distances[:-1]) >= 0.05
    assert [info["is_success"] for *_, info in rows] == [False] * (len(rows) - 1) + [True]
    _, reward, terminated, truncated, info = rows[-1]
    assert terminated and not truncated and info["reward_terms"]["reaching"] == 10 and 9.99 < reward < 10
    for distance in (0.0498, 0.0502):
        rows = rollout(make(task), [ZERO], seed=0, options=far(task, start=start, goal=(0.0, 0.52, 0.42 + distance)))
        assert rows[-1][4]["is_success"] == (rows[-1][4]["distance"] < 0.05) == (distance < 0.05)


def test_pick_and_place_succeeds_only_with_the_cube_grasped(make):
    env = make("pnp")
    start = (0.0, 0.52, 0.42)
    *_, info = rollout(env, [ZERO], seed=0, options={"start": start, "goal": start, "object": (1.0, 0.5, 0.45)})[-1]
    assert info["distance"] < 0.05 and not info["grasped"] and not info["is_success"]
    options = {"start": start, "goal": start, "object": start}
    _, reward, terminated, _, info = rollout(env, [ZERO], seed=0, options=options)[-1]
    assert info["grasped"] and info["is_success"] and terminated and 11.99 < reward < 12


def test_grasp_pays_two_once_and_the_cube_then_moves_with_the_tcp(make):
    options = {"start": (0.0, 0.52, 0.42), "goal": (1.5, 0.52, 0.42), "object": (0.0, 0.54, 0.43)}
    rows = rollout(make("pnp"), [ZERO] + [-TURN] * 30, seed=0, options=options)
    assert not rows[0][4]["grasped"]
    np.testing.assert_allclose(part(rows[0][0], "P_o"), cartesian(*options["object"]), rtol=0, atol=1e-7)
    assert [info["reward_terms"]["grasping"] for *_, info in rows[1:]] == [2] + [0] * 30
    for obs, *_, info in rows[1:]:
        assert info["grasped"]
        np.testing.assert_allclose(part(obs, "P_o"), part(obs, "P_g") - part(obs, "e"), rtol=0, atol=1e-6)
    assert np.linalg.norm(part(rows[-1][0], "P_o") - part(rows[1][0], "P_o")) > 0.2


def test_sectors_too_thin_for_any_demonstration_are_a_value_error(make):
    make("pnp", stage="demo", partitions=20).reset(seed=0)
    with pytest.raises(ValueError, match="partitions 24"):  # a cube is at least pi/12 from its goal
        make("pnp", stage="demo", partitions=24).reset(seed=0)


@pytest.mark.parametrize("task", TASKS)
def test_horizon_truncates_and_never_terminates_and_max_episode_steps_moves_it(make, task):
    for settings, horizon in (({}, TASKS[task].horizon), ({"max_episode_steps": 7}, 7)):
        rows = rollout(make(task, **settings), [ZERO] * 1000, seed=0, options=far(task))
        assert len(rows) - 1 == horizon
        assert [row[3] for row in rows] == [False] * horizon + [True]
        assert not any(row[2] for row in rows)


@pytest.mark.parametrize("task, K, partition, direction", [
    ("p2p", 4, 3, -1), ("p2p", 1, 0, 1), ("p2po", 3, 1, 1), ("pnp", 6, 2, -1), ("pnp", 4, 0, 1),
])  # fmt: skip
def test_demonstration_is_truncated_where_the_tcp_leaves_its_sector(make, task, K, partition, direction):
    env = make(task, stage="demo", partitions=K)
    centre = (partition - (0.5 if task == "p2p" else 0)) * 2 * PI / K
    options = {"partition": partition, "goal": (centre, 0.4, 0.55)}
    if task in CUBES:
        options["object"] = (centre, 0.5, 0.6)
    options["start"] = (centre + 0.3 * direction, 0.52, 0.35)  # clear of goal and cube
    rows = rollout(env, [-direction * TURN] * (200 if K > 1 else 350), seed=0, options=options)
    angles = [abs(wrap(cylinder(part(obs, "P_g") - part(obs, "e"))[0] - centre)) for obs, *_ in rows]
    assert not any(row[2] for row in rows)
    assert all(info["partition"] == partition for *_, info in rows)
    if K == 1:  # the sector is everything
        assert max(angles) > PI - 0.02 and not any(row[3] for row in rows[:-1])
        return
    assert angles[-1] > PI / K and max(angles[:-1]) <= PI / K + 1e-6
    assert [row[3] for row in rows] == [False] * (len(rows) - 1) + [True]


@pytest.mark.parametrize("task", TASKS)
def test_folding_the_hand_into_the_base_is_a_self_collision_that_terminates_with_minus_two(make, arm, task):
    rows = rollout(make(task), [FOLD] * 200, seed=0, options=far(task))
    obs, reward, terminated, truncated, info = rows[-1]
    assert info["collision"] == "self" and terminated and not truncated
    assert info["reward_terms"]["collision"] == -2 and -2.01 < reward < -2
    assert not any(row[4]["collision"] or row[2] for row in rows[:-1])
    # the arm of the test's own is clear ten steps earlier, and touches at most a step's way (3 cm) beyond the last
    gaps = []
    for other in (rows[-11][0], obs):
        arm.pose(part(other, "q"))
        hand_to_base = dict(linkIndexA=6, linkIndexB=-1, physicsClientId=arm.client)
        gaps.append(min(contact[8] for contact in pybullet.getClosestPoints(arm.body, arm.body, 0.5, **hand_to_base)))
    before, after = gaps
    assert before > 0.01 and after < 0.005


def test_other_ways_to_fold_are_self_collisions_too(make):
    for joints in ((0, 1, 1, 1), (0, -1, -1, -1), (0, -1, 1, -1)):
        rows = rollout(make("p2po"), [np.float32(joints)] * 400, seed=0, options=far("p2po"))
        assert rows[-1][4]["collision"] == "self"


@pytest.mark.parametrize("place", [(0.0, 0.465, 0.42), (0.0, 0.4, 0.42), (0.0, 0.3, 0.42), (0.0, 0.1, 0.5)])
@pytest.mark.parametrize("task", CUBES)
def test_cube_is_hit_by_any_link_on_p2po_and_by_any_but_the_gripper_on_pick_and_place(make, task, place):
    options = {"start": (0.0, 0.52, 0.42), "goal": (3.0, 0.5, 0.42), "object": place}
    _, reward, terminated, truncated, info = rollout(make(task), [ZERO], seed=0, options=options)[-1]
    hit = task == "p2po" or place[1] < 0.35  # the gripper begins 0.371 m out
    assert info["collision"] == ("cube" if hit else "")
    assert terminated == hit and not truncated
    assert info["reward_terms"]["collision"] == (-2 if hit else 0)


def test_cube_is_four_centimetres_wide_and_fits_between_the_open_fingers(make):
    env = make("p2po")
    for gap, hit in ((0.001, False), (-0.001, True)):
        # the palm ends 0.084 m from the flange, the TCP lies at 0.149 m
        centre = 0.52 - 0.149 + 0.084 + 0.02 + gap
        options = {"start": (0.0, 0.52, 0.42), "goal": (3.0, 0.5, 0.42), "object": (0.0, centre, 0.42)}
        *_, info = rollout(env, [ZERO], seed=0, options=options)[-1]
        assert (info["collision"] == "cube") == hit


# ---- pictures --------------------------------------------------------------------------------------------------------


def test_rgb_array_has_the_size_asked_and_shows_arm_goal_and_cube(make):
    make("pnp")  # PyBullet's default client, so that the one that draws is not
    env = make("pnp", render_mode="rgb_array", width=96, height=64)
    env.reset(seed=0, options=far("pnp"))
    first = env.render()
    assert first.shape == (64, 96, 3) and first.dtype == np.uint8
    assert first.max() > 200 and first.min() < 80  # white links, dark joints

    def differs(**options):
        env.reset(seed=0, options=far("pnp", **options))
        return np.any(np.abs(env.render().astype(int) - first) > 20, axis=-1).mean()

    assert differs() == 0
    assert differs(start=(2.5, 0.52, 0.42)) > 0.03
    assert differs(goal=(-1.0, 0.5, 0.4)) > 0.002
    assert differs(object=(-0.5, 0.5, 0.45)) > 0.0005
    plain = make("pnp")
    assert plain.unwrapped.render() is None  # and moves alike
    assert_same_bits(*(rollout(e, random_actions(0, 50), options=far("pnp")) for e in (env, plain)))
