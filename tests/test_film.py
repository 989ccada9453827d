"""film.py: what GIFs show, and that they show it in real time."""

from functools import partial

import numpy as np
import pytest
from PIL import Image

import film

START, GOAL = (-0.8, 0.5, 0.45), (0.3, 0.5, 0.45)


def still(obs):
    return np.zeros(4, dtype=np.float32)


@pytest.fixture
def make(make):
    return partial(make, render_mode="rgb_array", width=96, height=72)


def near(picture, colour, within=40):
    """(height, width) bool: where a picture has about this colour, of 0 ... 1."""
    return np.abs(np.asarray(picture, dtype=float)[..., :3] - 255 * np.array(colour)).max(-1) < within


def test_film_is_a_gif_of_the_episodes_in_real_time_with_frames_that_differ(make, tmp_path):
    env, path, seen = make(max_episode_steps=8), tmp_path / "arm.gif", []

    def act(obs):
        seen.append(obs)
        return np.array([1, 0, 0, 0], dtype=np.float32)

    film.film({"arm": (env, act)}, path, {"trial 3": 3, "trial 4": 4}, every=4)
    assert list(tmp_path.iterdir()) == [path]
    assert len(seen) == 16
    np.testing.assert_array_equal(seen[0], env.reset(seed=3)[0])
    np.testing.assert_array_equal(seen[8], env.reset(seed=4)[0])
    with Image.open(path) as image:
        assert image.format == "GIF" and image.size == (96, 72) and image.n_frames > 3
        durations, frames = [], set()
        for n in range(image.n_frames):
            image.seek(n)
            durations.append(image.info["duration"])
            frames.add(image.convert("RGB").tobytes())
    assert len(frames) > 3
    # a frame every 4 steps of 20 ms, and a rest of ten frames after each episode
    assert sum(durations) == 2 * (2 + 10) * 80 and durations[0] == 80


def test_an_orange_cube_stays_orange_in_a_gif(make, tmp_path):
    env = make("p2po", width=240, height=180, max_episode_steps=4)
    film.film({"arm": (env, still)}, tmp_path / "arm.gif", {"trial 0": 0})
    env.reset(seed=0)
    cube = near(env.render(), film.ORANGE, 60)
    with Image.open(tmp_path / "arm.gif") as image:
        seen = np.asarray(image.convert("RGB"), dtype=float)[cube]
    assert cube.sum() > 5 and np.all(seen[:, 0] > seen[:, 2] + 60)  # much more red than blue


@pytest.mark.parametrize("goal, colour", [(START, film.GREEN), (GOAL, film.RED)])
def test_an_episode_ends_with_a_border_green_for_success_and_red_for_failure(make, monkeypatch, goal, colour):
    env = make(max_episode_steps=2)
    reset, start = env.unwrapped.reset, (START[0], START[1], START[2] - 0.06)
    monkeypatch.setattr(env.unwrapped, "reset", lambda seed=None, options=None: reset(
        seed=seed, options={"start": start, "goal": goal}))  # fmt: skip
    up = lambda obs: np.array([0, -1, 0, 0], dtype=np.float32) if goal == START else still(obs)  # noqa: E731
    first, *_, last = film.frames({"arm": (env, up)}, {"trial 0": 0})
    edge = np.zeros((72, 96), dtype=bool)
    edge[:5] = edge[-5:] = edge[:, :5] = edge[:, -5:] = True
    assert near(last, colour, 2)[edge].all() and not near(first, colour, 2)[edge].any()


def test_the_goal_is_a_ball_one_sees_through_and_that_what_is_before_it_hides(make):
    env = make(width=320, height=240)
    options = {"start": START, "goal": (2.4, 0.6, 0.5)}

    def ball(**other):
        env.reset(seed=0, options=options | other)
        with_goal = env.render().astype(int)
        env.unwrapped.goal = None
        return np.abs(with_goal - env.render()).max(-1) > 8, with_goal

    changed, picture = ball()
    across = np.flatnonzero(changed.any(0)), np.flatnonzero(changed.any(1))
    assert abs(np.ptp(across[0]) - np.ptp(across[1])) <= 2  # round, but for perspective
    assert near(picture, film.GREEN, 60)[changed].sum() < changed.sum() / 2  # the floor shines through
    behind, _ = ball(goal=(np.pi / 2 + np.radians(38) + 0.15, 0.3, 0.45))  # half behind the column
    assert 0 < behind.sum() < 0.9 * changed.sum()


def test_agents_go_by_what_their_names_do_not_share():
    names = ["data/results/p2p-ddpg-robust-mirror-seed0", "data/runs/p2p-ddpg-robust-gas-seed0"]
    assert film.short(names) == ["mirror", "gas"]
    assert film.short(names[:1]) == ["p2p-ddpg-robust-mirror-seed0"]
    assert film.short(["a/one", "b/one"]) == ["one", "one"]  # nothing but folders tells them apart


@pytest.mark.extras
def test_an_mp4_has_the_frames_of_a_gif(make, tmp_path):
    import imageio.v3

    film.film({"arm": (make(max_episode_steps=8), still)}, tmp_path / "arm.mp4", {"trial 3": 3})
    assert imageio.v3.immeta(tmp_path / "arm.mp4")["fps"] == 12.5
    assert len(imageio.v3.imread(tmp_path / "arm.mp4")) == 12
