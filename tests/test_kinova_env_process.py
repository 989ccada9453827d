"""kinova_env.py: copies, misuse, and many environments in one process."""

import copy
import gc
import pickle
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import kinova_env
from kinova_env import TASKS, URDF, KinovaEnv
from test_kinova_env import FOLD, TURN, ZERO, assert_same_bits, far, random_actions, rollout

# ---- copies and misuse -----------------------------------------------------------------------------------------------


COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("task", TASKS)
def test_a_copy_goes_on_as_the_original_would_and_leaves_it_alone(task, how):
    env, rng = gymnasium.make(TASKS[task].env_id, stage="demo", partitions=3), np.random.default_rng(0)
    env.reset(seed=3)
    env.reset(options={"partition": 1})
    for _ in range(5):
        env.step(0.3 * rng.uniform(-1, 1, 4))
    other = COPIES[how](env)
    actions = 0.3 * rng.uniform(-1, 1, (8, 4))
    there = [other.step(a)[:4] for a in actions]  # first: the original must not have moved with it
    here = [env.step(a)[:4] for a in actions]
    for one, same in zip(here, there, strict=True):
        assert np.array_equal(one[0], same[0]) and one[1:] == same[1:]
    other.close()
    env.step(actions[0])  # closing the copy closed nothing else
    env.close()


def test_a_copy_draws_the_episodes_that_the_original_would_draw(make):
    env = make("pnp")
    env.reset(seed=5)
    other = copy.deepcopy(env)
    assert other.unwrapped.episode == env.unwrapped.episode
    for _ in range(3):
        assert np.array_equal(env.reset()[0], other.reset()[0])
    other.close()
    assert np.array_equal(copy.deepcopy(make("p2p")).reset(seed=1)[0], make("p2p").reset(seed=1)[0])  # before any reset


def test_a_copy_plays_what_was_asked_for_whatever_became_of_the_lists_since(make):
    env, action, options = make("p2p").unwrapped, [0.3, 0.2, 0.1, 0.0], {"goal": (1.6, 0.5, 0.4)}
    env.reset(options=options)
    env.step(action)
    action[:], options["goal"] = [1.0] * 4, (-1.6, 0.5, 0.4)
    other = copy.deepcopy(env)
    assert other.q == env.q and other.goal == env.goal
    other.close()


def test_an_environment_that_is_dropped_takes_its_simulator_along():
    client = KinovaEnv()._client
    gc.collect()
    assert not kinova_env.pybullet.isConnected(client)


def test_misuse_is_one_clear_line():
    env = KinovaEnv(render_mode="rgb_array", width=32, height=24)
    with pytest.raises(RuntimeError, match=r"step\(\) before reset\(\)"):
        env.step(np.zeros(4))
    env.reset(seed=0)
    env.close()
    env.close()
    uses = {"reset()": env.reset, "step()": lambda: env.step(np.zeros(4)), "render()": env.render,
            "a copy": lambda: copy.deepcopy(env)}  # fmt: skip
    for name, use in uses.items():
        with pytest.raises(RuntimeError, match=re.escape(f"{name} after close()")):
            use()


# ---- one process, many environments, many episodes -------------------------------------------------------------------


def test_interleaved_environments_behave_as_each_does_alone_bit_for_bit(make):
    plans = [(task, random_actions(seed, 120)) for seed, task in enumerate([*TASKS, "p2p"])]
    plans[1] = ("p2po", [FOLD] * 120)  # one of them ends early
    alone = [rollout(make(task), actions, seed=7, options=far(task)) for task, actions in plans]
    envs = [make(task) for task, _ in plans]
    together = [rollout(env, [], seed=7, options=far(task)) for env, (task, _) in zip(envs, plans, strict=True)]
    for t in range(120):
        for env, (_, actions), rows in zip(envs, plans, together, strict=True):
            if not rows[-1][2]:
                rows.append(env.step(actions[t]))
    for one, other in zip(alone, together, strict=True):
        assert_same_bits(one, other)


def test_importing_starts_no_simulator_and_no_environment_touches_the_default_client():
    """A simulator opened first is PyBullet's default: its bodies, settings and clock stay as they were."""
    script = """
import pybullet
client = pybullet.connect(pybullet.DIRECT)
assert client == 0
ball = pybullet.createMultiBody(1.0, pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1), -1, [0, 0, 1])
pybullet.resetBaseVelocity(ball, [1, 2, 3])
def snapshot():
    return (pybullet.getNumBodies(), pybullet.getBasePositionAndOrientation(ball), pybullet.getBaseVelocity(ball),
            pybullet.getPhysicsEngineParameters(), pybullet.isConnected(0))
before = snapshot()
import gymnasium, kinova_env, numpy
assert not any(pybullet.isConnected(client) for client in range(1, 10))
for task, row in kinova_env.TASKS.items():
    for mode in (None, "rgb_array"):
        env = gymnasium.make(row.env_id, render_mode=mode, width=32, height=24)
        for seed in range(2):
            env.reset(seed=seed)
            for _ in range(150):
                if env.step(numpy.float32([0.7, 1, -1, -1]))[2]:
                    break
        env.reset()
        mode and env.render()
        env.close()
        assert not any(pybullet.isConnected(client) for client in range(1, 10))
assert snapshot() == before, (snapshot(), before)
print("same")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=Path(URDF).parents[2])
    assert done.stdout.endswith("same\n"), done.stderr


BEFORE = {  # what happens in the episode before, and how it ends
    "self": ("self", [FOLD] * 200, {}),
    "timeout": ("", random_actions(5, 150), {}),
    "cube": ("cube", [-TURN] * 200, {"object": (1.0, 0.5, 0.42)}),
    "grasp": ("", [ZERO] + [-TURN] * 20, {"object": (0.3, 0.52, 0.42)}),
}


@pytest.mark.parametrize("task, before", [("p2p", "self"), ("p2p", "timeout"), ("p2po", "cube"), ("pnp", "grasp")])
def test_episode_does_not_depend_on_the_one_before_it_bit_for_bit(make, task, before):
    collision, actions, options = BEFORE[before]
    for after in (random_actions(6, 150), [FOLD] * 150):
        fresh = rollout(make(task), after, seed=11)
        env = make(task)
        end = rollout(env, actions, seed=0, options=far(task, **options))[-1][4]
        assert end["collision"] == collision and end["grasped"] == (before == "grasp")
        assert_same_bits(rollout(env, after, seed=11), fresh)
        assert_same_bits(rollout(env, after, seed=11), fresh)


@pytest.mark.parametrize("task, stage", [("p2p", "train"), ("p2po", "demo"), ("pnp", "test")])
def test_same_seed_is_the_same_run_of_episodes_and_another_seed_another(make, task, stage):
    def three(seed):
        env = make(task, stage=stage)
        return [row for n in range(3) for row in rollout(env, random_actions(n, 30), seed=seed if n == 0 else None)]

    first = three(4)
    assert_same_bits(first, three(4))
    assert first[0][0].tobytes() != three(5)[0][0].tobytes()
