"""gas.py: the symmetry against the simulator, the group law, types and shapes, partitions and aggregation."""

import math
import runpy
from dataclasses import replace

import numpy as np
import pytest
import torch

import gas
import kinova_env
from kinova_env import INDEX, OBS_DIM, OBSERVATION, TASKS, KinovaEnv, tcp, wrap
from pid_demo import PID, record

PI = math.pi
CUBES = [task for task in TASKS if TASKS[task].cube]
ANGLES = [PI / 2, PI, 1.234, -2.5]
ROWS = ("obs", "act", "rew", "obs2", "terminated", "truncated", "episode")


@pytest.mark.parametrize("how, offset", [("vector", 0.5), ("vecotr", 0.0), ("", 0.0)])
def test_of_one_observation_width_there_is_one_layout_and_one_set_of_sectors(monkeypatch, how, offset):
    """The maps know a task by the width alone; another layout would silently be turned as the first one's is."""
    monkeypatch.setitem(OBSERVATION, "pnp", [*OBSERVATION["p2po"][:-1], ("P_o", 3, how)])
    monkeypatch.setitem(TASKS, "pnp", replace(TASKS["pnp"], sector_offset=offset))
    with pytest.raises(ValueError, match="p2po and pnp"):
        runpy.run_path(gas.__file__)


def rollout(task, actions, options, stage="train", partitions=4):
    """(obs (T+1, width) float64, act, rew, terminated, truncated, last info); actions: arrays, or None for the PID."""
    env = KinovaEnv(task, stage, partitions)
    pid = PID(env, "fast")
    obs = [env.reset(seed=0, options=options)[0]]
    rows = []
    for action in actions:
        action = pid.act() if action is None else action
        s, reward, terminated, truncated, info = env.step(action)
        obs.append(s)
        rows.append((action, reward, terminated, truncated))
        if terminated or truncated:
            break
    env.close()
    act, rew, terminated, truncated = (np.array(column) for column in zip(*rows, strict=True))
    return np.array(obs, dtype=float), act, rew, terminated, truncated, info


def turned(options, angle):
    """Explicit options of the episode in the world turned by `angle`."""
    return {name: (place[0] + angle, place[1], place[2]) for name, place in options.items()}


def difference(obs, other):
    """Largest difference of two batches of states, joint angles compared modulo 2 pi."""
    delta = np.asarray(obs, dtype=float) - np.asarray(other, dtype=float)
    delta[..., :4] = wrap(delta[..., :4])
    return np.abs(delta).max()


def states(width, shape=(50,), seed=0, dtype=np.float64):
    """States as the environment gives them (angles with their own sine and cosine), otherwise random."""
    rng = np.random.default_rng(seed)
    obs = rng.uniform(-1, 1, (*shape, width))
    obs[..., :4] = rng.uniform(-PI, PI, (*shape, 4))
    obs[..., 4:8], obs[..., 8:12] = np.sin(obs[..., :4]), np.cos(obs[..., :4])
    return obs.astype(dtype)


# ---- against the simulator -------------------------------------------------------------------------------------------

PLACES = {"start": (0.3, 0.52, 0.42), "goal": (1.6, 0.5, 0.4)}
IN_THE_WAY = PLACES | {"object": (0.9, 0.5, 0.42)}
ASIDE = PLACES | {"object": (2.2, 0.5, 0.45)}
AT_START = PLACES | {"object": (0.3, 0.54, 0.43)}
RANDOM = list(np.random.default_rng(1).uniform(-1, 1, (20, 4)).astype(np.float32).repeat(10, axis=0))
FOLD = [np.array([0.7, 1.0, -1.0, -1.0], dtype=np.float32)] * 120
TURN = [np.array([-1.0, 0.1, 0.0, 0.0], dtype=np.float32)] * 60
EPISODES = {  # task, actions, options, how it ends
    "p2p random": ("p2p", RANDOM, PLACES, None),
    "p2p self": ("p2p", FOLD, PLACES, "self"),
    "p2p success": ("p2p", [None] * 400, PLACES, "success"),
    "p2po random": ("p2po", RANDOM, ASIDE, None),
    "p2po self": ("p2po", FOLD, ASIDE, "self"),
    "p2po cube": ("p2po", TURN, IN_THE_WAY, "cube"),
    "p2po success": ("p2po", [None] * 400, ASIDE, "success"),
    "pnp random": ("pnp", RANDOM, ASIDE, None),
    "pnp self": ("pnp", FOLD, ASIDE, "self"),
    "pnp cube": ("pnp", TURN, PLACES | {"object": (0.9, 0.25, 0.42)}, "cube"),
    "pnp success": ("pnp", [None] * 400, AT_START, "success"),
}


@pytest.mark.parametrize("name", EPISODES)
def test_phi_of_a_simulated_episode_is_the_simulated_rotated_episode(name):
    task, actions, options, end = EPISODES[name]
    obs, act, rew, terminated, _, info = rollout(task, actions, options)
    assert (info["collision"] or ("success" if info["is_success"] else None)) == end
    for angle in ANGLES:
        obs_, _, rew_, terminated_, _, info_ = rollout(task, list(act), turned(options, angle))
        assert len(obs_) == len(obs)
        assert difference(gas.rotate(obs, angle), obs_) < 1e-6
        assert np.abs(rew - rew_).max() < 1e-6
        assert np.array_equal(terminated, terminated_)
        assert [info[key] for key in ("is_success", "collision", "grasped")] == [
            info_[key] for key in ("is_success", "collision", "grasped")
        ]
        k = round(angle / (PI / 2))
        if k == angle / (PI / 2):
            assert difference(gas.phi(obs, k), obs_) < 1e-6


@pytest.mark.parametrize("task, K", [("p2p", 4), ("p2po", 3), ("pnp", 4)])
def test_phi_of_a_demonstration_is_the_demonstration_in_the_other_partition_and_ends_with_it(task, K):
    """The TCP leaves its sector at the same step as its image leaves the sector k places further round."""
    centre = -PI / K if task == "p2p" else 0.0
    options = {"start": (centre, 0.52, 0.42), "goal": (centre - 0.3, 0.4, 0.54)}
    options |= {"object": (centre - 0.5, 0.5, 0.6)} if task in CUBES else {}
    away = [np.array([-1.0, 0.2, 0.1, 0.0], dtype=np.float32)] * 200
    obs, _, rew, terminated, truncated, _ = rollout(task, away, options | {"partition": 0}, "demo", K)
    assert truncated[-1] and not terminated.any()
    for k in range(1, K):
        there = turned(options, 2 * PI * k / K) | {"partition": k}
        obs_, _, rew_, terminated_, truncated_, _ = rollout(task, away, there, "demo", K)
        assert np.array_equal(truncated, truncated_) and np.array_equal(terminated, terminated_)
        assert difference(gas.phi(obs, k, K), obs_) < 1e-6
        assert np.abs(rew - rew_).max() < 1e-6


# ---- the maps --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_what_rotates_is_what_the_observation_layout_says(task):
    obs = states(OBS_DIM[task])
    angle = 0.7
    out = gas.rotate(obs, angle)
    for name, _, rotates in OBSERVATION[task]:
        old, new = obs[:, INDEX[task][name]], out[:, INDEX[task][name]]
        if rotates == "":
            expected = old
        elif rotates == "vector":
            c, s = math.cos(angle), math.sin(angle)
            expected = old @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        else:
            first = {"angle": wrap(obs[:, 0] - angle), "sine": np.sin(obs[:, 0] - angle)}
            first["cosine"] = np.cos(obs[:, 0] - angle)
            expected = np.column_stack([first[rotates], old[:, 1:]])
        np.testing.assert_allclose(new, expected, rtol=0, atol=1e-12, err_msg=name)
    assert {rotates for *_, rotates in OBSERVATION[task]} == {"angle", "sine", "cosine", "", "vector"}


@pytest.mark.parametrize("use", [lambda obs: gas.phi(obs, 0), gas.canonical, gas.cylinder, gas.partition_of])
def test_width_is_what_decides_and_any_other_is_a_value_error(use):
    for wrong in (np.zeros((3, 24)), torch.zeros(3, 4)):
        with pytest.raises(ValueError, match=f"width {wrong.shape[-1]}"):
            use(wrong)


@pytest.mark.parametrize("K", [1, 3, 4])
def test_phi_of_phi_is_phi_of_the_sum_modulo_K(K):
    obs = states(25)
    for a in range(K):
        for b in range(K):
            assert difference(gas.phi(gas.phi(obs, b, K), a, K), gas.phi(obs, (a + b) % K, K)) < 1e-12
        assert np.array_equal(gas.phi(obs, a + K, K), gas.phi(obs, a, K))
        assert np.array_equal(gas.phi(obs, a - K, K), gas.phi(obs, a, K))


def test_phi_moves_every_state_and_four_partitions_are_the_default():
    obs = states(22)
    assert difference(gas.phi(obs, 1), obs) > 1
    assert np.array_equal(gas.phi(obs, 1), gas.phi(obs, 1, 4))
    assert difference(gas.phi(obs, 1, 3), gas.phi(obs, 1)) > 0.1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_phi_0_returns_a_copy_that_is_the_same_bit_for_bit(dtype):
    obs = states(22, dtype=dtype)
    obs[0, 0], obs[1, 16], obs[2, 0] = 17.0, -0.0, PI  # not even wrapped
    for k in (0, 4, -4):
        same = gas.phi(obs, k)
        assert same.tobytes() == obs.tobytes() and not np.shares_memory(same, obs)
        tensor = torch.from_numpy(obs)
        same = gas.phi(tensor, k)
        assert same.numpy().tobytes() == obs.tobytes() and same.data_ptr() != tensor.data_ptr()


def test_psi_is_the_identity():
    action = np.random.default_rng(0).uniform(-1, 1, (7, 4)).astype(np.float32)
    for k in range(4):
        assert gas.psi(action, k).tobytes() == action.tobytes()
        assert torch.equal(gas.psi(torch.from_numpy(action), k, 4), torch.from_numpy(action))


MAPS = {
    "rotate": lambda obs: gas.rotate(obs, 0.7),
    "phi": lambda obs: gas.phi(obs, 3),
    "phi of 5": lambda obs: gas.phi(obs, 2, 5),
    "canonical": gas.canonical,
    "cylinder": gas.cylinder,
}


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("width, dtype, shape", [
    (22, np.float32, ()), (22, np.float64, (2, 0, 3)), (25, np.float32, (6,)), (25, np.float64, (2, 3)),
])  # fmt: skip
def test_maps_keep_type_dtype_and_shape_of_numpy_and_torch_and_leave_their_input_alone(name, width, dtype, shape):
    obs = states(width, shape, dtype=dtype)
    tensor, before = torch.from_numpy(obs.copy()), obs.copy()
    out, tensor_out = MAPS[name](obs), MAPS[name](tensor)
    assert type(out) is np.ndarray and out.dtype == dtype and out.shape == (*shape, width)
    assert type(tensor_out) is torch.Tensor and tensor_out.dtype == tensor.dtype and tensor_out.shape == out.shape
    assert obs.tobytes() == before.tobytes() and tensor.numpy().tobytes() == before.tobytes()
    if out.size:
        assert difference(out, before) > 1e-3
        exact = MAPS[name](states(width, shape))
        # float32 numbers up to pi are 2.4e-7 apart; "Exact but for the rounding of the dtype"
        tolerance = 1e-6 if dtype == np.float32 else 1e-12
        assert max(difference(out, exact), difference(tensor_out.numpy(), exact)) < tolerance


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_array_of_angles_turns_each_state_by_its_own(dtype):
    obs = states(25, (5, 3), dtype=dtype)
    angles = np.random.default_rng(1).uniform(-2 * PI, 2 * PI, (5, 3)).astype(dtype)
    for array, turn in ((obs, angles), (torch.from_numpy(obs), torch.from_numpy(angles))):
        out = gas.rotate(array, turn)
        assert out.dtype == array.dtype
        for i in range(5):
            for j in range(3):
                assert difference(out[i, j], gas.rotate(array[i, j], float(turn[i, j]))) < 1e-6
        # one angle a column, for every row
        assert difference(gas.rotate(array, turn[0])[4], gas.rotate(array[4], turn[0])) == 0


def test_rotate_keeps_the_first_angle_within_the_half_open_circle_and_is_undone_by_its_inverse():
    obs = states(25, (500,))
    for angle in (*ANGLES, 7.0, -100.0):
        out = gas.rotate(obs, angle)
        assert np.all((out[:, 0] >= -PI) & (out[:, 0] < PI))
        assert difference(gas.rotate(out, -angle), obs) < 1e-12


@pytest.mark.parametrize("width", [22, 25])
def test_canonical_has_no_base_angle_is_idempotent_and_the_same_for_every_rotated_world(width):
    obs = states(width)
    out = gas.canonical(obs)
    base = [INDEX["p2p"][name].start for name in ("q", "sin q", "cos q")]
    for array in (out, gas.canonical(obs.astype(np.float32)), gas.canonical(torch.from_numpy(obs)).numpy()):
        assert np.all(array[:, base] == (0, 0, 1))
    assert np.array_equal(gas.canonical(out), out)
    for angle in ANGLES:
        assert difference(gas.canonical(gas.rotate(obs, angle)), out) < 1e-12
    assert difference(gas.canonical(gas.rotate(obs, np.linspace(-PI, PI, 50))), out) < 1e-12
    # it is a rotation: nothing else is lost
    assert difference(gas.rotate(out, -obs[:, 0]), obs) < 1e-12


@pytest.mark.parametrize("task", TASKS)
def test_cylinder_is_the_same_for_every_rotated_world_and_loses_nothing_else(task):
    obs = states(OBS_DIM[task])
    own, out = gas.canonical(obs), gas.cylinder(obs)
    for angle in ANGLES:
        turned_world = gas.cylinder(gas.rotate(obs, angle)) - out
        assert np.abs(np.where(np.abs(turned_world) > 6, np.abs(turned_world) - 2 * PI, turned_world)).max() < 1e-12
    P_g, e = INDEX[task]["P_g"], INDEX[task]["e"]
    assert np.array_equal(out[:, :16], own[:, :16])  # the joints as in `canonical`

    def place(rho_theta_z):
        rho, theta, z = rho_theta_z.T
        return np.stack([rho * np.cos(theta), rho * np.sin(theta), z], axis=1)

    assert difference(place(out[:, P_g]), own[:, P_g]) < 1e-12
    assert difference(place(out[:, P_g] - out[:, e]), own[:, P_g] - own[:, e]) < 1e-12  # P_e
    if task in CUBES:
        P_o = INDEX[task]["P_o"]
        assert difference(place(out[:, P_o]), own[:, P_o]) < 1e-12
    assert np.all(np.abs(out[:, e][:, 1]) <= PI)


def test_a_turn_of_the_goal_changes_two_entries_of_cylinder():
    env = KinovaEnv("p2p")
    seen = [gas.cylinder(env.reset(options={"goal": (math.pi / 4 + turn, 0.5, 0.4)})[0]) for turn in (0.3, 1.0, 2.8)]
    env.close()
    theta_g, theta_e = INDEX["p2p"]["P_g"].start + 1, INDEX["p2p"]["e"].start + 1
    for after, turn in zip(seen[1:], (0.7, 2.5), strict=True):
        expected = seen[0].copy()
        expected[[theta_g, theta_e]] += turn
        assert difference(after, expected) < 1e-6


def test_grasped_sees_the_same_in_every_view():
    obs, *_ = rollout("pnp", [None] * 200, {})
    assert 0 < kinova_env.grasped(obs.astype(np.float32)).mean() < 1
    for view in ("canonical", "cylinder"):
        assert np.array_equal(kinova_env.grasped(gas.seen(obs.astype(np.float32), view)), kinova_env.grasped(obs))


@pytest.mark.parametrize("task", TASKS)
def test_mirrored_actions_lead_through_mirrored_states_to_a_millimetre(task):
    options = {"start": (0.9, 0.52, 0.42), "goal": (1.9, 0.45, 0.5)} | ({"object": (2.2, 0.55, 0.45)} if task in CUBES
                                                                        else {})  # fmt: skip
    obs, act, *_ = rollout(task, [None] * 300, options)
    assert len(act) > 40 and np.ptp(obs[:, 0]) > 0.5
    mirrored, mirrored_act = gas.mirror(obs[:-1], act)
    other, *_ = rollout(task, mirrored_act, {name: (-theta, *rest) for name, (theta, *rest) in options.items()})
    n = min(len(other), len(mirrored))
    assert n > len(act) - 3
    start = INDEX[task]["P_g"].start
    np.testing.assert_allclose(other[:n, start:], mirrored[:n, start:], rtol=0, atol=0.0015)
    assert difference(other[:n, start:], obs[:n, start:]) > 0.5


@pytest.mark.parametrize("width", [22, 25])
def test_mirror_is_its_own_inverse_and_reflects_in_every_frame(width):
    obs, act = states(width), np.random.default_rng(0).uniform(-1, 1, (50, 4))
    for s, a in ((obs, act), (torch.from_numpy(obs), torch.from_numpy(act))):
        there, back = gas.mirror(s, a), gas.mirror(*gas.mirror(s, a))
        assert difference(np.asarray(back[0]), obs) == 0 and difference(np.asarray(back[1]), act) == 0
        assert np.array_equal(np.asarray(there[1]), act * (-1, 1, 1, 1)) and type(there[0]) is type(s)
        for frame in (gas.canonical, gas.cylinder):
            assert difference(np.asarray(frame(there[0])), np.asarray(gas.mirror(frame(s), a)[0])) < 1e-12


def test_seen_is_the_state_itself_but_for_the_arms_own_frame():
    obs = states(25)
    for symmetry in gas.SYMMETRIES:
        own = {"canonical": gas.canonical, "cylinder": gas.cylinder, "mirror": gas.cylinder}.get(symmetry)
        assert np.array_equal(gas.seen(obs, symmetry), own(obs) if own else obs)


def test_goal_minus_error_turns_as_the_tcp_does_and_is_the_tcp_of_the_rotated_joints():
    obs, *_ = rollout("p2po", RANDOM[:50], ASIDE)
    P_g, e = INDEX["p2po"]["P_g"], INDEX["p2po"]["e"]
    for angle in ANGLES:
        out = gas.rotate(obs, angle)
        here, there = (o[:, P_g] - o[:, e] for o in (obs, out))
        c, s = math.cos(angle), math.sin(angle)
        assert np.abs(there - here @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).max() < 1e-6
        assert np.abs(there - [tcp(q) for q in out[:, :4]]).max() < 1e-6
        # what the reward is made of: lengths do not change
        assert np.abs(np.linalg.norm(out[:, e], axis=1) - np.linalg.norm(obs[:, e], axis=1)).max() < 1e-12


# ---- partitions ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task, K", [("p2p", 4), ("p2p", 1), ("p2po", 5), ("pnp", 3)])
def test_demonstrations_start_in_the_partition_they_were_drawn_in(task, K):
    env = KinovaEnv(task, "demo", K)
    for k in range(K):
        obs, info = env.reset(seed=k, options={"partition": k})
        assert info["partition"] == gas.partition_of(obs, K) == k
        assert gas.partition_of(torch.from_numpy(obs), K).item() == k
    env.close()


def at(task, theta):
    """A state whose TCP is at this azimuth (theta: (...))."""
    theta = np.asarray(theta)
    obs = states(OBS_DIM[task], theta.shape)
    place = np.stack([0.5 * np.cos(theta), 0.5 * np.sin(theta), np.full(theta.shape, 0.4)], axis=-1)
    obs[..., INDEX[task]["e"]] = obs[..., INDEX[task]["P_g"]] - place
    return obs


@pytest.mark.parametrize("task, K", [("p2p", 4), ("p2po", 3), ("pnp", 8)])
def test_partition_changes_where_the_sectors_of_the_environment_meet(task, K):
    env = KinovaEnv(task, "demo", K)
    half = PI / K
    for k in range(K):
        centre = env.sector_start(k)
        assert centre == pytest.approx((k - (0.5 if task == "p2p" else 0)) * 2 * half)
        inside = at(task, centre + half * np.array([-1 + 1e-6, -0.5, 0, 0.5, 1 - 1e-6]))
        assert gas.partition_of(inside, K).tolist() == [k] * 5
        beyond = at(task, centre + half * np.array([-1 - 1e-6, 1 + 1e-6]))
        assert gas.partition_of(beyond, K).tolist() == [(k - 1) % K, (k + 1) % K]
    env.close()


@pytest.mark.parametrize("task", ["p2p", "pnp"])
def test_partition_numbers_are_whole_have_the_batch_shape_and_count_up_under_phi(task):
    obs = at(task, np.random.default_rng(0).uniform(-PI, PI, (6, 5)))
    for K in (1, 3, 4):
        number = gas.partition_of(obs, K)
        assert number.shape == (6, 5) and number.dtype == np.int64 and set(number.flat) == set(range(K))
        tensor = gas.partition_of(torch.from_numpy(obs), K)
        assert tensor.dtype == torch.int64 and np.array_equal(tensor.numpy(), number)
        for k in range(K):
            assert np.array_equal(gas.partition_of(gas.phi(obs, k, K), K), (number + k) % K)
    assert np.array_equal(gas.partition_of(obs), gas.partition_of(obs, 4))
    assert gas.partition_of(obs[0, 0]).shape == ()


# ---- aggregation -----------------------------------------------------------------------------------------------------


def demonstration(task, k, K, options):
    """One PID episode of partition k, explicit options, as `pid_demo.record` would hold it."""
    placed = turned(options, 2 * PI * k / K) | {"partition": k}
    obs, act, rew, terminated, truncated, info = rollout(task, [None] * 500, placed, "demo", K)
    rows = {"obs": obs[:-1], "act": act, "rew": rew, "obs2": obs[1:], "terminated": terminated, "truncated": truncated}
    rows["episode"] = np.zeros(len(rew), dtype=np.int64)
    whole = {"partition": k, "success": info["is_success"], "length": len(rew), "return": rew.sum()}
    return rows | {name: np.array([value]) for name, value in whole.items()}


@pytest.mark.parametrize("task, K", [("p2p", 4), ("p2po", 3), ("pnp", 4)])
def test_aggregated_images_are_the_simulated_demonstrations_of_their_partitions(task, K):
    centre = -PI / K if task == "p2p" else 0.0
    options = {"start": (centre, 0.52, 0.42), "goal": (centre - 0.5, 0.45, 0.5)}
    if task == "p2po":
        options["object"] = (centre + 0.2, 0.5, 0.6)
    elif task == "pnp":
        options["object"] = (centre, 0.53, 0.43)  # grasped at once
    images = gas.aggregate(demonstration(task, 0, K, options), K)
    assert images["partition"].tolist() == list(range(K)) and images["success"].all()
    for k in range(K):
        real = demonstration(task, k, K, options)
        image = images["episode"] == k
        assert images["length"][k] == real["length"][0] == image.sum()
        for name in ("obs", "obs2"):
            assert difference(images[name][image], real[name]) < 1e-6
        for name in ("act", "rew", "terminated", "truncated"):
            assert np.abs(images[name][image] - real[name].astype(float)).max() < 1e-6
        assert images["return"][k] == pytest.approx(real["return"][0], abs=1e-6)
        assert images["success"][k] == real["success"][0]


@pytest.fixture(scope="module")
def demos():
    """Ten real P2P demonstrations of random partitions."""
    demos, _ = record("p2p", 10, gains="fast", seed=0)
    assert 2 <= (demos["partition"] == 0).sum() < 10
    return demos


@pytest.mark.parametrize("K", [2, 4])
def test_aggregate_gives_each_episode_of_partition_0_and_then_its_images_and_nothing_else(demos, K):
    before = {name: column.copy() for name, column in demos.items()}
    out = gas.aggregate(demos, K)
    assert list(out) == list(demos)
    sources = np.flatnonzero(demos["partition"] == 0)
    assert out["partition"].tolist() == list(range(K)) * len(sources)
    assert np.array_equal(np.unique(out["episode"]), np.arange(K * len(sources)))
    assert np.all(np.diff(out["episode"]) >= 0)
    for name in ("success", "length", "return"):
        assert np.array_equal(out[name], np.repeat(demos[name][sources], K))
    for n, source in enumerate(sources):
        theirs = demos["episode"] == source
        for k in range(K):
            image = out["episode"] == n * K + k
            for name in ("act", "rew", "terminated", "truncated"):  # phi changes neither
                assert np.array_equal(out[name][image], demos[name][theirs])
            for name in ("obs", "obs2"):
                assert np.array_equal(out[name][image], gas.phi(demos[name][theirs], k, K))
    for name, column in demos.items():
        assert out[name].dtype == column.dtype and column.tobytes() == before[name].tobytes()
        assert len(out[name]) == (out["length"].sum() if name in ROWS else K * len(sources))


def test_aggregate_drops_the_surplus_beyond_num_demos(demos):
    everything = gas.aggregate(demos, 4)
    for count in (1, 3, 4, 6):
        out = gas.aggregate(demos, 4, count)
        rows = everything["length"][:count].sum()
        for name in demos:
            assert np.array_equal(out[name], everything[name][: rows if name in ROWS else count])
    plenty = gas.aggregate(demos, 4, 1000)
    assert all(np.array_equal(plenty[name], everything[name]) for name in demos)


def test_aggregate_of_demonstrations_without_partition_0_is_empty_with_the_same_columns(demos):
    other = demos | {"partition": demos["partition"] * 0 + 1}
    out = gas.aggregate(other, 4)
    for name, column in demos.items():
        assert len(out[name]) == 0 and out[name].dtype == column.dtype and out[name].shape[1:] == column.shape[1:]


def test_images_lie_in_the_partition_they_are_numbered_with(demos):
    out = gas.aggregate(demos, 4)
    numbers = gas.partition_of(out["obs"], 4)
    assert np.array_equal(numbers, out["partition"][out["episode"]])
