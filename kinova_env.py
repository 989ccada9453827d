"""The Kinova Gen3 environment of Demo-EASE in PyBullet: reach, reach past an obstacle, pick and place (Sec. 4).

    import gymnasium, kinova_env
    env = gymnasium.make("KinovaP2P-v0", stage="train")           # or KinovaP2PO-v0, KinovaPnP-v0
    obs, info = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())

The class docstring of `KinovaEnv` says what goes in and what comes out. Importing this file starts no simulator.
"""

import contextlib
import math
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path

import gymnasium
import numpy as np

import film
from film import pybullet

URDF = Path(__file__).parent / "data" / "robot" / "gen3_2f85.urdf"


@dataclass(frozen=True)
class Task:
    """One row of the task table (Sec. 4). Angles in rad, lengths in m."""

    env_id: str
    horizon: int  # T, steps (Tables 1 and 2)
    speed: float  # fraction of the joint velocity limits that |a| = 1 asks for
    cube: str  # "" (none), "obstacle" (P2P-O) or "object" (P&P)
    sector_offset: float  # sector k's demonstrations start at the angle (k + sector_offset) * 2*pi/K
    test_theta: float  # start angle of the test study


# To add a task: a row here and in OBSERVATION (P_g, then e, first among vectors; new names in BOUND); its own rules in
# _draw, step and PID.act; TASK_DEFAULTS, for --recipe robust ROBUST_TASK too, in both algorithm files; TITLES in
# tables.py; tests are then of it too. Tasks of one observation width share layout and sector_offset (gas.py).
# --symmetry mirror, robust's, holds only where left and right are alike. sweep.py runs the paper's tasks alone.
TASKS = {
    "p2p": Task("KinovaP2P-v0", 400, 0.5, "", -0.5, -math.pi / 4),
    "p2po": Task("KinovaP2PO-v0", 500, 1.0, "obstacle", 0.0, -math.pi / 2),
    "pnp": Task("KinovaPnP-v0", 800, 1.0, "object", 0.0, -math.pi / 2),
}

# The observation, Eq. 2: (name, width, how it changes when the world is rotated about the base axis).
_STATE = [
    ("q", 4, "angle"),  # the first entry shifts
    ("sin q", 4, "sine"),  # the sine of that first entry
    ("cos q", 4, "cosine"),
    ("q_dot", 4, ""),  # unchanged
    ("P_g", 3, "vector"),  # x and y rotate
    ("e", 3, "vector"),
]
OBSERVATION = {
    "p2p": _STATE,
    "p2po": _STATE + [("P_o", 3, "vector")],
    "pnp": _STATE + [("P_o", 3, "vector")],
}
OBS_DIM = {task: sum(width for _, width, _ in layout) for task, layout in OBSERVATION.items()}
INDEX = {}  # INDEX[task][name]: the slice of the observation
for _task, _layout in OBSERVATION.items():
    _ends = np.cumsum([width for _, width, _ in _layout]).tolist()
    INDEX[_task] = {name: slice(end - width, end) for (name, width, _), end in zip(_layout, _ends, strict=True)}

# No entry leaves [-bound, bound]: the arm reaches 1.33 m, and 20 rad/s is far beyond what its motors can do.
BOUND = {"q": math.pi, "sin q": 1.0, "cos q": 1.0, "q_dot": 20.0, "P_g": 2.0, "e": 4.0, "P_o": 2.0}

# Where goals are drawn, radius and height in m (Eq. 10): on train and test, and on demo. All are within reach.
RHO, Z = (0.3, 0.7), (0.25, 0.65)
RHO_DEMO, Z_DEMO = (0.4, 0.6), (0.35, 0.55)
CUBE_DRAWS = 50  # of a P&P cube for one goal

# Reward, Eq. 11, and the grasp rule.
ALPHA_1, ALPHA_2 = 2e-3, 1e-3
R_1, R_2, R_3 = 10.0, 2.0, 2.0
EPSILON = 0.05  # m
EPSILON_Q = 0.3  # rad

# The robot (data/robot/gen3_2f85.urdf; a test holds these figures against it).
ACTIVE_JOINTS = (0, 1, 2, 4)  # Actuators 1, 2, 3 and 5: the paper's #1 ... #4
TAU_MAX = (39.0, 39.0, 39.0, 9.0)  # N m
VELOCITY_MAX = (1.39, 1.39, 1.39, 1.22)  # rad/s
JOINT_LIMITS = np.array([np.inf, 2.41, 2.66, 2.23])  # rad, symmetric
GRIPPER_LINK = 6
SHOULDER_HEIGHT = 0.15643 + 0.12838
UPPER_ARM, FOREARM, HAND = 0.41, 0.20843 + 0.10593, 0.10593 + 0.061525 + 0.149
SIDE = 0.006375 + 2 * 0.00017505 - 0.005375  # the TCP lies this far to the left of the arm's plane
TIME_STEP = 0.02  # s: 50 Hz, one physics step per action
CUBE_SIZE = 0.04  # m
STAGES = ("train", "demo", "test")


def tcp(q):
    """Forward kinematics. q: 4 joint angles (rad). Returns (x, y, z) of the tool centre point in m."""
    q1, q2, q3, q5 = q
    forearm = q2 - q3
    hand = forearm - q5
    r = UPPER_ARM * math.sin(q2) + FOREARM * math.sin(forearm) + HAND * math.sin(hand)
    z = UPPER_ARM * math.cos(q2) + FOREARM * math.cos(forearm) + HAND * math.cos(hand) + SHOULDER_HEIGHT
    c, s = math.cos(q1), math.sin(q1)  # joint 1 points down: world yaw is -q1
    return r * c + SIDE * s, SIDE * c - r * s, z


def postures(position, pitch=None):
    """Inverse kinematics, closed form: joint angles that put the TCP at `position`, within the joint limits.

    position: (3,) in m; pitch: angle(s) of the approach axis above the horizontal in rad, by default a grid of half
    degrees all round. Returns (M, 4) joint angles in rad, M = 0 if there is none; residual under 1e-9 m. The arm always
    faces the target (reaching over its own back is left out).
    """
    x, y, z = (float(c) for c in position)
    rho = math.hypot(x, y)
    if rho <= abs(SIDE):
        return np.empty((0, 4))
    if pitch is None:
        pitch = np.radians(np.arange(-180, 180, 0.5))
    hand = math.pi / 2 - np.atleast_1d(np.asarray(pitch, dtype=float))  # angle of the hand from the vertical
    q1 = math.asin(SIDE / rho) - math.atan2(y, x)
    r_wrist = math.sqrt(rho**2 - SIDE**2) - HAND * np.sin(hand)
    z_wrist = z - SHOULDER_HEIGHT - HAND * np.cos(hand)
    cos_q3 = (r_wrist**2 + z_wrist**2 - UPPER_ARM**2 - FOREARM**2) / (2 * UPPER_ARM * FOREARM)
    within = np.abs(cos_q3) <= 1
    hand, r_wrist, z_wrist, cos_q3 = hand[within], r_wrist[within], z_wrist[within], cos_q3[within]
    found = []
    for q3 in (-np.arccos(cos_q3), np.arccos(cos_q3)):  # elbow up (the start poses), elbow down
        q2 = np.arctan2(r_wrist, z_wrist) - np.arctan2(-FOREARM * np.sin(q3), UPPER_ARM + FOREARM * np.cos(q3))
        q2 = wrap(q2)
        found.append(np.stack([np.full_like(q2, q1), q2, q3, wrap(q2 - q3 - hand)], axis=-1))
    found = np.concatenate(found)
    return found[np.all(np.abs(found) <= JOINT_LIMITS, axis=-1)]


def grasp_postures(cube):
    """Joint angles (M, 4) that grasp a P&P cube at `cube` (3,), with the smallest |pitch| <= EPSILON_Q; M may be 0."""
    found = postures(cube, 0.0)  # horizontal first
    if len(found):
        return found
    steps = np.radians(np.arange(0.5, math.degrees(EPSILON_Q) - 0.5, 0.5))
    found = postures(cube, np.concatenate([steps, -steps]))
    pitch = np.abs(wrap(math.pi / 2 - (found[:, 1] - found[:, 2] - found[:, 3])))
    return found[pitch < pitch.min(initial=math.inf) + 1e-6]


def grasped(obs):
    """Whether the cube is in the gripper, P_o = P_e, in P&P observations (..., 25), numpy or torch. Returns (...)."""
    P_g, e, P_o = (obs[..., INDEX["pnp"][name]] for name in ("P_g", "e", "P_o"))
    return ((P_o - P_g + e) ** 2).sum(-1) < 1e-6  # 1 mm


def start_posture(theta, rho, z):
    """Joint angles (4,) of a start pose: TCP at cylinder coordinates (rad, m, m), tool horizontal and radially outward.

    Raises ValueError where the arm cannot be so.
    """
    if rho < 0:
        raise ValueError(f"start {(theta, rho, z)}: rho must be at least 0")
    found = postures(cartesian(theta, rho, z), 0.0)
    if not len(found):
        raise ValueError(f"start {(theta, rho, z)}: no posture puts a horizontal tool there")
    return found[0]


def cartesian(theta, rho, z):
    """Cylinder coordinates (rad, m, m) to (3,) m."""
    return np.array([rho * math.cos(theta), rho * math.sin(theta), z])


def wrap(angle):
    """Angle(s) in rad to [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


class KinovaEnv(gymnasium.Env):
    """A 4-joint Kinova Gen3 with a 2F-85 gripper that reaches (P2P, P2P-O) or picks and places (P&P).

    ## Description
    The arm stands at the origin and moves its tool centre point (TCP) to a goal in the tube around it: `KinovaP2P-v0`
    plainly, `KinovaP2PO-v0` past a fixed 4 cm cube, `KinovaPnP-v0` carrying a cube that it has to grasp first. The task
    is exactly symmetric under rotation about the base axis (`gas.py`). Control runs at 50 Hz, one physics step each.

    ## Action space
    `Box(-1, 1, (4,), float32)`: reference joint velocities, each scaled by its joint's limit and the task's speed
    (0.5 on P2P, 1 on the others); values outside are clipped, NaN is a ValueError.

    | index | joint | scale (rad/s) | torque limit (N m) |
    |---|---|---|---|
    | 0 | Actuator1 | 1.39 | 39 |
    | 1 | Actuator2 | 1.39 | 39 |
    | 2 | Actuator3 | 1.39 | 39 |
    | 3 | Actuator5 | 1.22 | 9 |

    ## Observation space
    `Box(-bound, bound, (22,), float32)`, (25,) with a cube (Eq. 2); `INDEX[task][name]` is a slice:

    | index | name | unit | bound | meaning |
    |---|---|---|---|---|
    | 0-3 | q | rad | pi | joint angles; the first wrapped to [-pi, pi) |
    | 4-7 | sin q | - | 1 | their sines |
    | 8-11 | cos q | - | 1 | their cosines |
    | 12-15 | q_dot | rad/s | 20 | joint velocities |
    | 16-18 | P_g | m | 2 | goal |
    | 19-21 | e | m | 4 | P_g - P_e, goal minus TCP |
    | 22-24 | P_o | m | 2 | cube (P2P-O and P&P); moves with the gripper once grasped |

    ## Rewards
    The sum of five terms (Eq. 11), each in `info["reward_terms"]`:

    | term | value |
    |---|---|
    | distance | -0.002 * norm(e) (P&P before the grasp: of P_o - P_e) |
    | effort | -0.001 * norm(tau_hat), tau_hat = abs(motor torque) / limit |
    | reaching | 10 on success |
    | collision | -2 on collision |
    | grasping | 2 at the first grasp (P&P) |

    The cube is grasped once the TCP is within 0.05 m of it and the gripper's orientation within 0.3 rad of the cube's,
    which is level and at the azimuth that it was drawn at; it then stays in the gripper.

    ## Starting state
    Cylinder coordinates (theta, rho, z) of TCP, goal and cube, tool horizontal and radially outward:

    | stage | start | goal |
    |---|---|---|
    | train | pi/4, 0.52, 0.42 | [-pi, pi), [0.3, 0.7), [0.25, 0.65) |
    | test | -pi/4 (P2P) or -pi/2, 0.5, 0.45 | as train |
    | demo | the start of sector k of K, 0.52, 0.42, each joint +- 0.02 rad | in the sector, [0.4, 0.6), [0.35, 0.55) |

    The cube lies at theta_goal +- [pi/12, pi/6), rho in [0.4, 0.6), z within 0.1 of the goal's. On stage "demo" the
    goals of tasks with a cube lie in the sector's clockwise half, and P&P cubes in the sector. Two things are drawn
    again. A P&P cube on which the hand, tilted by at most 0.3 rad, cannot be centred (a twelfth of all; some 70 % of
    these could be grasped from beside), or that lies outside its sector: the cube alone, so that goals stay uniform.
    The whole draw, where it starts in collision or at the goal, or where 50 cubes in a row did not do for a P&P goal:
    never in 20,000 goals of each stage, at times where sectors are narrow (K > 10); for an explicit goal that is a
    ValueError.

    ## Episode end
    Terminated: success (norm(e) < 0.05, on P&P with the cube grasped), or collision: `info["collision"]` is "self" for
    the arm with itself, "cube" for any link with the cube (P&P: any but the gripper). Truncated: the registered horizon
    (400, 500, 800 steps), and on stage "demo" the TCP's azimuth leaving its sector.

    ## Arguments
    `gymnasium.make(id, stage="train", partitions=4, render_mode=None, width=640, height=480, max_episode_steps=...)`;
    `reset(seed=..., options={"partition": k, "start": (theta, rho, z), "goal": ..., "object": ...})`, each optional;
    explicit options are never drawn again, and an unreachable one is a ValueError that names it.
    `info` holds `is_success`, `collision`, `grasped`, `distance` (m), `effort` (norm of tau_hat) and `reward_terms`.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 50}

    def __init__(self, task="p2p", stage="train", partitions=4, render_mode=None, width=640, height=480):
        if task not in TASKS:
            raise ValueError(f"task {task!r}: must be one of {', '.join(TASKS)}")
        if stage not in STAGES:
            raise ValueError(f"stage {stage!r}: must be one of {', '.join(STAGES)}")
        for name, value in (("partitions", partitions), ("width", width), ("height", height)):
            if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
                raise ValueError(f"{name} {value!r}: must be a whole number of at least 1")
        if render_mode not in (None, "human", "rgb_array"):
            raise ValueError(f"render_mode {render_mode!r}: must be None, 'human' or 'rgb_array'")
        if render_mode == "human" and not film.has_display():
            raise ValueError("render_mode 'human': needs a display, and there is none; use 'rgb_array'")
        self.task, self.stage, self.partitions = task, stage, partitions
        self.row = TASKS[task]
        self.render_mode, self.width, self.height = render_mode, width, height
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        bound = np.concatenate([np.full(width, BOUND[name]) for name, width, _ in OBSERVATION[task]]).astype(np.float32)
        self.observation_space = gymnasium.spaces.Box(-bound, bound)
        self._velocity_scale = [v * self.row.speed for v in VELOCITY_MAX]
        self.episode = 0  # counts resets, so that a controller sees a new episode
        self.goal = self._began = None
        with film.silence(*[1, 2] * (render_mode == "human")):
            self._client = film.open_window() if render_mode == "human" else pybullet.connect(pybullet.DIRECT)
            self._build_world()

    # ---- world ----------------------------------------------------------------------------------------------------

    def _build_world(self):
        id_ = {"physicsClientId": self._client}
        pybullet.resetSimulation(**id_)
        pybullet.setGravity(0, 0, -9.81, **id_)
        # With this slop the solver never pushes touching links apart: contacts are read, not felt, and stay symmetric.
        settings = dict(fixedTimeStep=TIME_STEP, deterministicOverlappingPairs=1, contactSlop=1.0)
        pybullet.setPhysicsEngineParameter(**settings, **id_)
        flags = (
            pybullet.URDF_USE_INERTIA_FROM_FILE
            | pybullet.URDF_USE_IMPLICIT_CYLINDER
            | pybullet.URDF_USE_SELF_COLLISION
            | pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
        )
        if not self.render_mode:
            flags |= pybullet.URDF_IGNORE_VISUAL_SHAPES
        self._robot = pybullet.loadURDF(str(URDF), useFixedBase=True, flags=flags, **id_)
        for link in range(-1, GRIPPER_LINK + 1):
            pybullet.changeDynamics(self._robot, link, linearDamping=0, angularDamping=0, **id_)
        # Links that Actuators 4 and 6 hold together can never meet: not parent and child, so excluded by hand.
        pybullet.setCollisionFilterPair(self._robot, self._robot, 4, 6, 0, **id_)
        self._cube = None
        if self.row.cube:
            box = dict(shapeType=pybullet.GEOM_BOX, halfExtents=[CUBE_SIZE / 2] * 3)
            shape = pybullet.createCollisionShape(**box, **id_)
            visual = pybullet.createVisualShape(**box, rgbaColor=[*film.ORANGE, 1], **id_)
            self._cube = pybullet.createMultiBody(0, shape, visual, [0, 0, -1], **id_)
            # The cube never pushes: an episode ends on contact (P2P-O), or the cube has no response at all (P&P).
            pybullet.setCollisionFilterGroupMask(self._cube, -1, 0, 0, **id_)
        if self.render_mode:
            self._mark_goal = film.furnish(self._client, self._robot, self.render_mode == "human", EPSILON)
        self._touched = False

    # ---- sampling -------------------------------------------------------------------------------------------------

    def sector_start(self, partition):
        """Start angle in rad of demonstration sector k, which is also the sector's centre (Sec. 4.1)."""
        return (partition + self.row.sector_offset) * 2 * math.pi / self.partitions

    def _draw(self, options):
        """One draw of (start posture (4,), goal (3,), cube (3,) or None); explicit options are taken as they are."""
        uniform = self.np_random.uniform
        if self.stage == "demo":
            centre, half = self.sector_start(self.partition), math.pi / self.partitions
            start, jitter = (centre, 0.52, 0.42), uniform(-0.02, 0.02, 4)
            theta = uniform(centre - half, centre + (0 if self.row.cube else half))
            goal = (theta, uniform(*RHO_DEMO), uniform(*Z_DEMO))
        else:
            start = (math.pi / 4, 0.52, 0.42) if self.stage == "train" else (self.row.test_theta, 0.5, 0.45)
            jitter = 0.0
            goal = (uniform(-math.pi, math.pi), uniform(*RHO), uniform(*Z))
        if "start" in options:
            start, jitter = options["start"], 0.0
        goal, cube = options.get("goal", goal), None
        for _ in range(CUBE_DRAWS if self.row.cube else 0):
            side = self.np_random.choice([-1.0, 1.0])
            theta = goal[0] + side * uniform(math.pi / 12, math.pi / 6)
            cube = (theta, uniform(0.4, 0.6), uniform(goal[2] - 0.1, goal[2] + 0.1))
            cube = options.get("object", cube)
            if "object" in options or self._cube_fits(cube):
                break
        else:
            if self.row.cube and "goal" in options:
                raise ValueError(f"goal {tuple(goal)}: none of {CUBE_DRAWS} cubes drawn beside it can be grasped")
        return start_posture(*start) + jitter, goal, cube

    def _cube_fits(self, cube):
        """Whether a sampled P&P cube can be grasped and, on demo, lies in the sector; P2P-O's always fits."""
        if self.row.cube == "obstacle":
            return True
        if self.stage == "demo" and abs(wrap(cube[0] - self.sector_start(self.partition))) > math.pi / self.partitions:
            return False
        return len(grasp_postures(cartesian(*cube))) > 0

    def _playable(self, goal, cube, explicit):
        """Whether an episode may begin: not at the goal, no collision, and a cube that fits or is explicit."""
        if math.dist(tcp(self.q), cartesian(*goal)) < EPSILON or self._collision():
            return False
        return cube is None or explicit or self._cube_fits(cube)

    def _check_options(self, options):
        unknown = set(options) - {"partition", "start", "goal", "object"}
        if unknown:
            raise ValueError(f"options {sorted(map(str, unknown))}: allowed are partition, start, goal, object")
        if "partition" in options:
            if self.stage != "demo":
                raise ValueError(f"partition: only stage 'demo' has partitions, this is stage {self.stage!r}")
            if options["partition"] not in range(self.partitions):
                raise ValueError(f"partition {options['partition']!r}: must be in 0 ... {self.partitions - 1}")
        if "object" in options and not self.row.cube:
            raise ValueError(f"object: task {self.task!r} has none")
        for name in ("start", "goal", "object"):
            if name not in options:
                continue
            try:
                place = np.asarray(options[name], dtype=float)
            except (TypeError, ValueError):
                place = np.empty(0)
            if place.shape != (3,) or not np.all(np.isfinite(place)) or place[1] < 0:
                raise ValueError(f"{name} {options[name]!r}: must be three finite numbers (theta, rho >= 0, z)")
            place = place.tolist()
            if name == "start":
                start_posture(*place)
            elif name == "object" and self.row.cube == "object":
                if not len(grasp_postures(cartesian(*place))):
                    raise ValueError(f"object {tuple(place)}: no posture puts a level hand at its centre")
            elif not len(postures(cartesian(*place))):
                raise ValueError(f"{name} {tuple(place)}: out of the arm's reach")

    # ---- Gymnasium ------------------------------------------------------------------------------------------------

    def reset(self, *, seed=None, options=None):
        """(observation, info); options as in the class's docstring. Raises ValueError that names an unreachable one."""
        if self._client is None:
            raise RuntimeError("reset() after close()")
        super().reset(seed=seed)
        options = dict(options or {})  # a copy: it is kept
        self._check_options(options)
        self._began, self._actions = (self.np_random.bit_generator.state, options), []
        self.episode += 1
        if self._touched:
            self._build_world()  # contacts leave caches behind: an episode must not depend on the one before it
        self.partition = None
        if self.stage == "demo":
            self.partition = int(options.get("partition", self.np_random.integers(self.partitions)))
        self.grasped = False
        fixed = {"start", "goal"} | ({"object"} if self.row.cube else set())
        for _ in range(1 if fixed <= set(options) else 1000):  # explicit options may leave no draw that is playable
            posture, goal, cube = self._draw(options)
            self._place(posture, cube)
            if self._playable(goal, cube, explicit="object" in options):
                break
        else:
            if self.stage == "demo" and set(options) <= {"partition"}:
                raise ValueError(f"partitions {self.partitions}: too many, no {self.task} demonstration fits a sector")
        self.goal = cartesian(*goal).tolist()
        if self.render_mode:
            self._mark_goal(self.goal)
        if self.render_mode == "human":
            self._show()
        e = [g - p for g, p in zip(self.goal, self.tcp, strict=True)]
        info = {"is_success": False, "collision": "", "grasped": False, "distance": math.hypot(*e), "effort": 0.0}
        info["reward_terms"] = dict.fromkeys(("distance", "effort", "reaching", "collision", "grasping"), 0.0)
        if self.partition is not None:
            info["partition"] = self.partition
        return self._observe(e), info

    def _place(self, posture, cube):
        for joint, angle in zip(ACTIVE_JOINTS, posture.tolist(), strict=True):
            pybullet.resetJointState(self._robot, joint, angle, 0.0, physicsClientId=self._client)
        self.q, self.q_dot, self.tcp = posture.tolist(), [0.0] * 4, tcp(posture.tolist())
        if cube is not None:
            self.cube = cartesian(*cube).tolist()
            self._cube_yaw = cube[0]
            self._move_cube(cube[0])

    def _move_cube(self, yaw):
        turned = [0, 0, math.sin(yaw / 2), math.cos(yaw / 2)]
        pybullet.resetBasePositionAndOrientation(self._cube, self.cube, turned, self._client)

    def step(self, action):
        """action (4,) in [-1, 1], clipped to it. Returns Gymnasium's five. Raises ValueError unless these are four
        numbers, none NaN."""
        if self.goal is None:
            raise RuntimeError(f"step() {'after close()' if self._client is None else 'before reset()'}")
        try:
            action = action.tolist() if isinstance(action, np.ndarray) else list(action)  # a copy: it is kept
            velocities = [scale * max(-1.0, min(1.0, a)) for scale, a in zip(self._velocity_scale, action, strict=True)]
            known = all(a == a for a in action)
        except (TypeError, ValueError):
            known = False
        if not known:
            raise ValueError(f"action {action!r}: must be 4 numbers, none NaN")
        self._actions.append(action)
        client = self._client
        pybullet.setJointMotorControlArray(self._robot, ACTIVE_JOINTS, pybullet.VELOCITY_CONTROL, forces=TAU_MAX,
                                           targetVelocities=velocities, physicsClientId=client)  # fmt: skip
        pybullet.stepSimulation(physicsClientId=client)
        j1, j2, j3, j5 = pybullet.getJointStates(self._robot, ACTIVE_JOINTS, physicsClientId=client)
        self.q, self.q_dot = (j1[0], j2[0], j3[0], j5[0]), (j1[1], j2[1], j3[1], j5[1])
        tau_hat = math.hypot(j1[3] / TAU_MAX[0], j2[3] / TAU_MAX[1], j3[3] / TAU_MAX[2], j5[3] / TAU_MAX[3])
        x, y, z = self.tcp = tcp(self.q)
        gx, gy, gz = self.goal
        e = (gx - x, gy - y, gz - z)
        distance = to_go = math.hypot(*e)

        first_grasp = False
        if self.row.cube == "object":
            if not self.grasped:
                first_grasp = self.grasped = self._grasps()
            if self.grasped:
                self.cube = list(self.tcp)
                if self.render_mode:
                    self._move_cube(-self.q[0])
            else:
                to_go = math.dist(self.cube, self.tcp)
        success = distance < EPSILON and (self.grasped or self.row.cube != "object")
        collision = self._collision()
        # Eq. 11
        r_dst, r_eft = -ALPHA_1 * to_go, -ALPHA_2 * tau_hat
        r_rch, r_cls, r_grsp = R_1 * success, -R_2 * bool(collision), R_3 * first_grasp
        info = dict(is_success=success, collision=collision, grasped=self.grasped, distance=distance, effort=tau_hat)
        info["reward_terms"] = dict(distance=r_dst, effort=r_eft, reaching=r_rch, collision=r_cls, grasping=r_grsp)
        truncated = False
        if self.stage == "demo":
            outside = abs(wrap(math.atan2(y, x) - self.sector_start(self.partition)))
            truncated = outside > math.pi / self.partitions  # left its sector: zeta of Sec. 3.2
            info["partition"] = self.partition
        if self.render_mode == "human":
            self._show()
        r = r_dst + r_eft + r_rch + r_cls + r_grsp
        return self._observe(e), r, success or collision != "", truncated, info

    def _observe(self, e):
        q1, q2, q3, q5 = self.q
        q1 = wrap(q1)
        sin, cos = math.sin, math.cos
        state = [q1, q2, q3, q5, sin(q1), sin(q2), sin(q3), sin(q5), cos(q1), cos(q2), cos(q3), cos(q5)]
        state += self.q_dot
        state += self.goal
        state += e
        if self.row.cube:
            state += self.cube
        return np.array(state, dtype=np.float32)

    def _collision(self):
        """ "", "self" (contacts that the last physics step began with) or "cube" (at the present posture)."""
        client = self._client
        for contact in pybullet.getContactPoints(self._robot, self._robot, physicsClientId=client):
            self._touched = True
            if contact[8] <= 0:  # signed distance
                return "self"
        if self.row.cube and not self.grasped:
            for contact in pybullet.getClosestPoints(self._robot, self._cube, 0.0, physicsClientId=client):
                if self.row.cube == "obstacle" or contact[3] != GRIPPER_LINK:
                    return "cube"
        return ""

    def _grasps(self):
        """r^grsp: TCP within EPSILON of the cube and the gripper's orientation within EPSILON_Q of the cube's."""
        if math.dist(self.cube, self.tcp) > EPSILON:
            return False
        yaw = -self.q[0] - self._cube_yaw
        pitch = math.pi / 2 - (self.q[1] - self.q[2] - self.q[3])
        # both are a yaw about the base axis, then a pitch: the angle between the two orientations is
        angle = 2 * math.acos(min(1.0, abs(math.cos(yaw / 2) * math.cos(pitch / 2))))
        return angle <= EPSILON_Q

    def _show(self):
        import time

        ahead = getattr(self, "_next_frame", 0.0) - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        self._next_frame = time.monotonic() + TIME_STEP

    def render(self):
        """ "rgb_array": (height, width, 3) uint8, drawn without a display. "human": None, the window draws itself."""
        if self.render_mode != "rgb_array":
            return None
        if self._client is None:
            raise RuntimeError("render() after close()")
        return film.picture(self._client, self.width, self.height, self.goal, EPSILON)

    def close(self):
        if self._client is not None:
            with film.silence(*[1, 2] * (self.render_mode == "human")):
                pybullet.disconnect(physicsClientId=self._client)
            self._client = self.goal = None

    def __del__(self):
        with contextlib.suppress(Exception):  # nothing was made, or PyBullet is gone at the interpreter's end
            self.close()

    # ---- copies ---------------------------------------------------------------------------------------------------
    # A simulator does not copy: copy.deepcopy and pickle make a new one and play the episode again, action by action.

    def __getstate__(self):
        if self._client is None:
            raise RuntimeError("a copy after close()")
        made_with = self.task, self.stage, self.partitions, self.render_mode, self.width, self.height
        state = {"made_with": made_with, "episode": self.episode, "spec": self.spec}
        if self._began:
            state |= {"began": self._began, "actions": self._actions}
        return state | {"random": (self._np_random, self._np_random_seed)}

    def __setstate__(self, state):
        self.__init__(*state["made_with"])
        if "began" in state:
            self.np_random.bit_generator.state, options = state["began"]
            self.reset(options=options)
            for action in state["actions"]:
                self.step(action)
        self._np_random, self._np_random_seed = state["random"]
        self.episode, self.spec = state["episode"], state["spec"]


for _task, _row in TASKS.items():
    gymnasium.register(
        _row.env_id, entry_point=f"{__name__}:KinovaEnv", max_episode_steps=_row.horizon, kwargs={"task": _task}
    )
