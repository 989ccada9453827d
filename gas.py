"""General Abstract Symmetry (Sec. 3.1): what stays the same when the world is turned about the robot's base axis.

    phi(obs, k, K=4)      the state map: the world turned by k * 2*pi/K           (Eq. 4)
    psi(action, k, K=4)   the action map: the identity, joint velocities stay     (Sec. 3.1)
    rotate(obs, angle)    the state map at any angle: the symmetry does not stop at K
    canonical(obs)        the world turned so that q_1 = 0: the state in the arm's own frame
    cylinder(obs)         the same frame, in the cylinder coordinates of Eq. 10
    mirror(obs, action)   left and right exchanged, in any of these frames
    seen(obs, symmetry)   the state as networks see it under --symmetry
    partition_of(obs, K)  which sector S_k the TCP is in                          (Definition 2)
    aggregate(demos, K)   one partition's demonstrations, turned into all K       (Sec. 3.2)

The maps take numpy arrays or torch tensors of any leading shape and return the same type, dtype and device.
Differs from the printed Eq. 4: P_g (and P_o) rotate too, else R(s, a) = R(phi(s), psi(a)) does not hold; and
q_1 falls where the world turns counter-clockwise, because joint 1 points down.
"""

import math

import numpy as np

from kinova_env import INDEX, OBS_DIM, OBSERVATION, TASKS, wrap

# By observation width, 22 or 25: where each part begins, by how it rotates; and the name of one task of that width: all
# of them share layout and sectors.
_ROTATES, _TASK = {}, {}
for _task, _layout in OBSERVATION.items():
    _first = _TASK.setdefault(OBS_DIM[_task], _task)
    if (_layout, TASKS[_task].sector_offset) != (OBSERVATION[_first], TASKS[_first].sector_offset):
        raise ValueError(f"tasks {_first} and {_task}: of one observation width, not of one layout or sector_offset")
    _ROTATES[OBS_DIM[_task]] = {how: [] for how in ("angle", "sine", "cosine", "", "vector")}
    for _name, _, _how in _layout:
        _ROTATES[OBS_DIM[_task]][_how].append(INDEX[_task][_name].start)


def _library(obs):
    """(array library, copy of obs, its rotation index); raises ValueError on a width that no task has."""
    if obs.shape[-1] not in _ROTATES:
        raise ValueError(f"observation of width {obs.shape[-1]}: must be one of {sorted(_ROTATES)}")
    index = _ROTATES[obs.shape[-1]]
    if isinstance(obs, np.ndarray):
        return np, obs.copy(), index
    import torch

    return torch, obs.clone(), index


def rotate(obs, angle):
    """The state with the world turned by `angle` rad about the base axis (Eq. 4 at any angle).

    obs: (..., 22 or 25) as KinovaEnv returns; angle: a number, or an array that broadcasts to obs.shape[:-1].
    Returns the same type, shape and dtype. Exact but for the rounding of the dtype (float32: 1e-6).
    """
    xp, out, index = _library(obs)
    c, s = (math.cos(angle), math.sin(angle)) if isinstance(angle, (int, float)) else (xp.cos(angle), xp.sin(angle))
    q1 = wrap(obs[..., index["angle"][0]] - angle)
    out[..., index["angle"][0]] = q1
    out[..., index["sine"][0]] = xp.sin(q1)
    out[..., index["cosine"][0]] = xp.cos(q1)
    for i in index["vector"]:
        x, y = obs[..., i], obs[..., i + 1]
        out[..., i], out[..., i + 1] = c * x - s * y, s * x + c * y
    return out


def phi(obs, k, K=4):
    """State map onto the partition k places further round (Eq. 4): the world turned by k * 2*pi/K.

    obs: (..., 22 or 25). phi_0 is the identity, bit for bit; phi_a of phi_b is phi_(a+b mod K), to rounding.
    """
    k = k % K
    return _library(obs)[1] if k == 0 else rotate(obs, k * 2 * math.pi / K)


def psi(action, k, K=4):
    """Action map (Sec. 3.1): the identity. action: (..., 4) joint velocities, the same in a turned world."""
    return action


def _facing_ahead(out, index):
    """q_1 = 0 in states of the arm's own frame, written into `out`."""
    for name, value in (("angle", 0.0), ("sine", 0.0), ("cosine", 1.0)):
        out[..., index[name][0]] = value
    return out


def canonical(obs):
    """The state in the arm's own frame: the world turned so that q_1 = 0 (then nothing about the base angle is left).

    obs: (..., 22 or 25). canonical(rotate(obs, angle)) equals canonical(obs) for every angle.
    """
    _, _, index = _library(obs)
    return _facing_ahead(rotate(obs, obs[..., index["angle"][0]]), index)


def cylinder(obs):
    """The state in the arm's own frame and in cylinder coordinates (rho, theta, z), as Eq. 10 draws goals.

    obs: (..., 22 or 25). P_g and P_o become (rho, theta, z), theta in rad from the arm's plane, and e becomes
    (rho_g - rho_e, theta_g - theta_e, z_g - z_e), the angle in [-pi, pi). The same for every turned world, like
    `canonical`; unlike there, how far the arm has to turn changes theta_g and e's angle alone, so that a network which
    has seen a few of these angles can act well at all of them.
    """
    xp, out, index = _library(obs)
    i_g, i_e, *i_o = index["vector"]
    x_e, y_e = obs[..., i_g] - obs[..., i_e], obs[..., i_g + 1] - obs[..., i_e + 1]
    theta_e = xp.arctan2(y_e, x_e)
    from_plane = wrap(theta_e + obs[..., index["angle"][0]])  # of the TCP: joint 1 points down
    for i in (i_g, *i_o):
        x, y = obs[..., i], obs[..., i + 1]
        rho, turn = xp.hypot(x, y), wrap(xp.arctan2(y, x) - theta_e)
        out[..., i], out[..., i + 1] = rho, from_plane + turn
        if i == i_g:
            out[..., i_e], out[..., i_e + 1] = rho - xp.hypot(x_e, y_e), turn
    return _facing_ahead(out, index)


def mirror(obs, action):
    """State and action with left and right exchanged: reflected in the arm's plane, or in the world's x-z plane where
    the state is of the world.

    obs: (..., 22 or 25), also of `canonical` or `cylinder`; action: (..., 4). Returns both, of the same types. Nearly
    exact: the TCP lies 1.35 mm beside the arm's plane (kinova_env.SIDE), so that e, or q_1, is off by twice that, and
    the masses of the links are not quite symmetric.
    """
    _, out, index = _library(obs)
    first = [index[name][0] for name in ("angle", "sine", "")]  # q_1, sin q_1, dq_1/dt
    for i in first + [start + 1 for start in index["vector"]]:  # and y or theta
        out[..., i] = -out[..., i]
    action = action.copy() if isinstance(action, np.ndarray) else action.clone()
    action[..., 0] = -action[..., 0]
    return out, action


def seen(obs, symmetry):
    """The state as networks see it under --symmetry: (..., 22 or 25), of `none`, `gas` and `so2` as it is."""
    return _VIEWS[symmetry](obs)


# so2 and mirror also change each batch: ReplayBuffer.sample (DDPG), TrajectoryBuffer.columns, Learner.demo_batch (PPO).
_VIEWS = dict.fromkeys(("none", "gas", "so2"), lambda obs: obs)
_VIEWS |= {"canonical": canonical, "cylinder": cylinder, "mirror": cylinder}
SYMMETRIES = tuple(_VIEWS)  # of --symmetry; whatever maps demonstrations also asks for "gas" by name


def partition_of(obs, K=4):
    """Number k of the sector S_k (Definition 2) that holds the TCP: (...) whole numbers in 0 ... K-1.

    Sectors are 2*pi/K wide and centred on their demonstration start angle.
    """
    xp, _, _ = _library(obs)
    task = _TASK[obs.shape[-1]]
    P_e = obs[..., INDEX[task]["P_g"]] - obs[..., INDEX[task]["e"]]
    theta = xp.arctan2(P_e[..., 1], P_e[..., 0])
    k = xp.floor(theta / (2 * math.pi / K) - TASKS[task].sector_offset + 0.5) % K
    return k.astype(np.int64) if xp is np else k.long()


def aggregate(demos, K=4, num_demos=None):
    """Demonstrations of partition 0, mapped to all K (Sec. 3.2): each episode, then its K - 1 images.

    demos: the arrays of `pid_demo.record` (rows: obs, act, rew, obs2, terminated, truncated, episode, perhaps
    executed; one entry an episode: the others); other partitions' episodes are left out. Returns the same arrays
    with K times the episodes, of which the first `num_demos` are kept. Rewards and ends do not change under phi.
    """
    rows = ("obs", "act", "rew", "obs2", "terminated", "truncated", "episode", "executed")
    images = {name: [] for name in demos}
    sources = np.flatnonzero(demos["partition"] == 0)
    total = len(sources) * K if num_demos is None else min(num_demos, len(sources) * K)
    for n in range(total):
        source, k = sources[n // K], n % K
        of_source = demos["episode"] == source
        for name in set(demos) - {"partition"}:
            images[name].append(demos[name][of_source] if name in rows else demos[name][source : source + 1])
        images["obs"][-1], images["obs2"][-1] = phi(images["obs"][-1], k, K), phi(images["obs2"][-1], k, K)
        for name in {"act", "executed"} & set(demos):
            images[name][-1] = psi(images[name][-1], k, K)
        images["episode"][-1] = np.full(of_source.sum(), n, dtype=demos["episode"].dtype)
        images["partition"].append(np.full(1, k, dtype=demos["partition"].dtype))
    return {name: np.concatenate(parts) if parts else demos[name][:0] for name, parts in images.items()}
