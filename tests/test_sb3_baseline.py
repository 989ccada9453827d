"""sb3_baseline.py: another library's agents leave folders like ours."""

import csv
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch

import evaluate
import logx
import pid_demo
import sb3_baseline
from kinova_env import TASKS

pytestmark = pytest.mark.extras


@pytest.fixture
def flags(tmp_path):
    return sb3_baseline.Flags(epochs=1, data_dir=str(tmp_path), eval_trials=1, quiet=True)


@pytest.mark.parametrize("algo", ["sac", "td3"])
def test_a_run_leaves_curves_a_tested_policy_and_demonstrations_where_asked(flags, algo):
    folder = sb3_baseline.train(replace(flags, algo=algo, num_demos=2))
    progress = list(csv.DictReader(open(folder / "progress.csv")))  # noqa: SIM115
    assert [row["env_steps"] for row in progress] == ["1000"] and 0 <= float(progress[0]["eval_success"]) <= 1
    episodes = list(csv.DictReader(open(folder / "episodes.csv")))  # noqa: SIM115
    assert episodes and sum(int(row["length"]) for row in episodes) <= 1000
    assert int(progress[0]["demo_env_steps"]) == len(pid_demo.record("p2p", 2, "fast", noise=0.2)[0]["rew"])
    rows, _ = evaluate.run_trials("p2p", folder, trials=1, quiet=True)
    assert rows[0]["length"] > 0


def test_a_finished_run_is_not_gone_on_with(flags):
    folder = sb3_baseline.train(replace(flags, name="a"))
    before = (folder / "episodes.csv").read_text()
    with pytest.raises(logx.BadInput, match="--epochs 2: a finished run cannot go on"):
        sb3_baseline.train(replace(flags, name="a", epochs=2, resume=True))
    assert (folder / "episodes.csv").read_text() == before


@pytest.mark.parametrize("algo", ["sac", "td3", "ddpg"])
def test_a_packed_policy_acts_as_the_model_does(flags, algo):
    model = sb3_baseline.make_model(sb3_baseline.resolve(replace(flags, algo=algo)))
    policy = evaluate.Policy(sb3_baseline.pack_policy(model, "p2p"))
    for obs in np.random.default_rng(0).normal(size=(5, 22)).astype(np.float32):
        np.testing.assert_allclose(policy(obs), model.predict(obs, deterministic=True)[0], atol=1e-6)


def test_preloaded_demonstrations_are_what_was_done_and_only_a_true_end_stops_bootstrapping(flags):
    f = sb3_baseline.resolve(replace(flags, num_demos=3))
    demos, _ = pid_demo.demonstrations(f)
    demos["terminated"][-1], demos["truncated"][-1] = False, True  # as if the last one had not come there in time
    model = sb3_baseline.make_model(f)
    sb3_baseline.preload(model, demos)
    buffer, n = model.replay_buffer, len(demos["rew"])
    assert buffer.pos == n and f.n_step == buffer.n_steps == 10
    np.testing.assert_array_equal(buffer.actions[:n, 0], demos["executed"])
    np.testing.assert_array_equal(buffer.next_observations[:n, 0], demos["obs2"])
    assert buffer.dones[n - 1, 0] == buffer.timeouts[n - 1, 0] == 1
    final = buffer.dones[:n, 0] * (1 - buffer.timeouts[:n, 0])
    np.testing.assert_array_equal(final, demos["terminated"])


def test_environments_of_another_process_are_trained_on_and_the_agent_is_tested_with_ours(tmp_path, monkeypatch):
    """As a user would, from another folder: SAC on two spawned environments, of each task."""
    from stable_baselines3 import SAC
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv

    monkeypatch.chdir(tmp_path)
    torch.set_num_threads(1)
    for task, row in TASKS.items():
        envs = make_vec_env(f"kinova_env:{row.env_id}", 2, vec_env_cls=SubprocVecEnv,
                            vec_env_kwargs={"start_method": "spawn"})  # fmt: skip
        model = SAC("MlpPolicy", envs, learning_starts=150).learn(200)
        envs.close()
        rows, _ = evaluate.run_trials(task, lambda s, model=model: model.predict(s, deterministic=True)[0], trials=1)
        assert gymnasium.spec(row.env_id).max_episode_steps >= rows[0]["length"] > 0
