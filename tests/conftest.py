"""What all tests share: torch as the scripts set it, so that results are the same in any shell, and environments."""

import gymnasium
import pybullet
import pytest
import torch

import plot_curves
import publish
import tables
from kinova_env import ACTIVE_JOINTS, TASKS, URDF

torch.set_num_threads(1)
torch.set_flush_denormal(True)


@pytest.fixture
def make():
    """gymnasium.make by the task's short name; closed at the end of the test."""
    opened = []

    def make_(task="p2p", **settings):
        opened.append(gymnasium.make(TASKS[task].env_id, disable_env_checker=True, **settings))
        return opened[-1]

    yield make_
    for env in opened:
        env.close()


class Arm:
    """The URDF alone in a simulator of the test's own, with gravity, free of KinovaEnv."""

    def __init__(self):
        self.client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=self.client)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
        flags |= pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
        self.body = pybullet.loadURDF(str(URDF), useFixedBase=True, flags=flags, physicsClientId=self.client)

    def pose(self, q):
        for joint, angle in zip(ACTIVE_JOINTS, q, strict=True):
            pybullet.resetJointState(self.body, joint, angle, physicsClientId=self.client)


@pytest.fixture
def arm():
    arm = Arm()
    yield arm
    pybullet.disconnect(physicsClientId=arm.client)


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """The default folders lie in an empty place, so that no test sees or writes real results."""
    monkeypatch.setattr(tables, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(tables, "RUNS", (tmp_path / "runs",))
    monkeypatch.setattr(plot_curves, "FIGURES", tmp_path / "figures")
    monkeypatch.setattr(publish, "TRIALS", 2)
    monkeypatch.setattr(publish, "PAGES", (tmp_path / "README.md", tmp_path / "results/README.md"))
