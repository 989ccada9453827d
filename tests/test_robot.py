"""data/robot and its kinematics in kinova_env.py: against the vendor's figures and PyBullet."""

import math
import xml.etree.ElementTree as ElementTree

import numpy as np
import pybullet
import pytest

import kinova_env
from kinova_env import URDF, cartesian, postures, start_posture, tcp, wrap

PI = math.pi

# The vendor's description: parent, xyz (m), rpy (multiples of pi), limit (rad; inf: continuous, 0: fixed), effort (N m)
JOINTS = {
    "Actuator1": ("base_link", (0, 0, 0.15643), (1, 0, 0), math.inf, 39),
    "Actuator2": ("shoulder_link", (0, 0.005375, -0.12838), (0.5, 0, 0), 2.41, 39),
    "Actuator3": ("bicep_link", (0, -0.41, 0), (1, 0, 0), 2.66, 39),
    "Actuator4": ("forearm_link", (0, 0.20843, -0.006375), (0.5, 0, 0), 0, None),
    "Actuator5": ("spherical_wrist_1_link", (0, -0.00017505, -0.10593), (-0.5, 0, 0), 2.23, 9),
    "Actuator6": ("spherical_wrist_2_link", (0, 0.10593, -0.00017505), (0.5, -0.5, 0), 0, None),
    "EndEffector": ("bracelet_link", (0, 0, -0.061525), (1, 0, -1), 0, None),
}
LINKS = {  # mass (kg), centre of mass (m), ixx, iyy, izz, iyz (kg m^2; None: "products <= 4.5e-4")
    "base_link": (1.697, (-0.000648, -0.000166, 0.084487), (0.004622, 0.004495, 0.002079), None),
    "shoulder_link": (1.377, (-2.3e-5, -0.010364, -0.07336), (0.00457, 0.004831, 0.001409), 0.000448),
    "bicep_link": (1.262, (3.5e-5, -0.208207, -0.01889), (0.046752, 0.00085, 0.047188), None),
    "forearm_link": (0.930, (1.8e-5, 0.076168, -0.01397), (0.008292, 0.000628, 0.008464), 0.000432),
    "spherical_wrist_1_link": (0.6781, (-1e-6, 0.008486, -0.062937), (0.001645, 0.001666, 0.000389), -0.000234),
    "spherical_wrist_2_link": (0.678, (-1e-6, 0.046429, -0.008704), (0.001685, 0.0004, 0.001696), 0.000255),
    "bracelet_link": (0.500, (0.000281, 0.011402, -0.029798), (0.000587, 0.000369, 0.000609), -0.000118),
    "gripper_link": (0.925, (0, 0, 0.05), None, None),
}
ROBOT = ElementTree.parse(URDF).getroot()


def numbers(text):
    return tuple(float(word) for word in text.split())


def joint_of(name):
    return ROBOT.find(f"joint[@name='{name}']")


def test_urdf_has_the_joints_and_links_of_the_vendors_tables_and_no_other():
    assert [joint.get("name") for joint in ROBOT.iter("joint")] == list(JOINTS)
    assert [link.get("name") for link in ROBOT.iter("link")] == list(LINKS)
    chain = list(LINKS)
    for (name, row), child in zip(JOINTS.items(), chain[1:], strict=True):
        assert (joint_of(name).find("parent").get("link"), joint_of(name).find("child").get("link")) == (row[0], child)


def test_joint_frames_limits_and_efforts_of_the_urdf_are_those_of_the_vendors_table_with_exact_pi():
    for name, (_, xyz, rpy, limit, effort) in JOINTS.items():
        joint = joint_of(name)
        assert numbers(joint.find("origin").get("xyz")) == xyz
        assert numbers(joint.find("origin").get("rpy")) == tuple(multiple * math.pi for multiple in rpy)
        assert joint.get("type") == {math.inf: "continuous", 0: "fixed"}.get(limit, "revolute")
        if limit:
            assert numbers(joint.find("axis").get("xyz")) == (0, 0, 1)
            assert float(joint.find("limit").get("effort")) == effort
        if 0 < limit < math.inf:
            assert [float(joint.find("limit").get(end)) for end in ("lower", "upper")] == [-limit, limit]


def test_masses_centres_and_inertias_of_the_urdf_are_those_of_the_vendors_table():
    for name, (mass, centre, diagonal, iyz) in LINKS.items():
        inertial = ROBOT.find(f"link[@name='{name}']/inertial")
        assert float(inertial.find("mass").get("value")) == mass
        assert numbers(inertial.find("origin").get("xyz")) == centre
        assert inertial.find("origin").get("rpy") is None
        inertia = {key: float(value) for key, value in inertial.find("inertia").attrib.items()}
        assert diagonal is None or (inertia["ixx"], inertia["iyy"], inertia["izz"]) == diagonal
        assert iyz is None or inertia["iyz"] == iyz
        assert all(abs(inertia[key]) <= 4.5e-4 for key in ("ixy", "ixz", "iyz"))


def test_pybullet_loads_every_mass_and_centre_of_mass_as_written(arm):
    for link, (mass, centre, *_) in enumerate(LINKS.values(), start=-1):
        dynamics = pybullet.getDynamicsInfo(arm.body, link, physicsClientId=arm.client)
        # a fixed base reads as mass 0
        assert dynamics[0] == (0 if link == -1 else mass)
        assert dynamics[3] == pytest.approx(centre, abs=1e-9)


def test_constants_of_the_module_are_those_of_the_urdf(arm):
    xyz = {name: row[1] for name, row in JOINTS.items()}
    joints = [pybullet.getJointInfo(arm.body, j, physicsClientId=arm.client) for j in range(len(JOINTS))]
    active = [joint_of(joints[j][1].decode()) for j in kinova_env.ACTIVE_JOINTS]
    assert [joint.get("name") for joint in active] == ["Actuator1", "Actuator2", "Actuator3", "Actuator5"]
    assert list(kinova_env.TAU_MAX) == [float(joint.find("limit").get("effort")) for joint in active]
    assert list(kinova_env.VELOCITY_MAX) == [float(joint.find("limit").get("velocity")) for joint in active]
    assert list(kinova_env.JOINT_LIMITS) == [float(joint.find("limit").get("upper", "inf")) for joint in active]
    assert joints[kinova_env.GRIPPER_LINK][12].decode() == "gripper_link"
    assert xyz["Actuator1"][2] - xyz["Actuator2"][2] == kinova_env.SHOULDER_HEIGHT
    assert -xyz["Actuator3"][1] == kinova_env.UPPER_ARM
    assert xyz["Actuator4"][1] - xyz["Actuator5"][2] == kinova_env.FOREARM
    assert xyz["Actuator6"][1] - xyz["EndEffector"][2] + 0.149 == kinova_env.HAND
    side = -xyz["Actuator2"][1] - xyz["Actuator4"][2] - xyz["Actuator5"][1] - xyz["Actuator6"][2]
    assert abs(kinova_env.SIDE - side) < 1e-15


def test_base_and_shoulder_collision_shapes_are_symmetric_about_the_base_axis():
    for name in ("base_link", "shoulder_link"):
        for shape in ROBOT.findall(f"link[@name='{name}']/collision"):
            assert shape.find("geometry/cylinder") is not None
            assert numbers(shape.find("origin").get("xyz"))[:2] == (0, 0)
            assert shape.find("origin").get("rpy") is None


def test_tcp_is_pybullets_own_link_state_at_random_postures(arm):
    for q in np.random.default_rng(0).uniform(-1, 1, (200, 4)) * (PI, 2.41, 2.66, 2.23):
        arm.pose(q)
        state = pybullet.getLinkState(arm.body, 6, computeForwardKinematics=True, physicsClientId=arm.client)
        approach = np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))[:, 2]
        # 1e-7 is what PyBullet's own quaternions and single-precision URDF numbers leave
        np.testing.assert_allclose(tcp(q), state[4] + 0.149 * approach, rtol=0, atol=3e-7)


def test_flange_and_tcp_of_the_check_posture(arm):
    q = (0, *np.radians((15, -130, 55)))
    arm.pose(q)
    flange = pybullet.getLinkState(arm.body, 6, computeForwardKinematics=True, physicsClientId=arm.client)[4]
    assert flange == pytest.approx((0.4539, 0.0014, 0.4233), abs=5.1e-5)
    assert tcp(q) == pytest.approx((0.6029, 0.0014, 0.4233), abs=5.1e-5)


def test_start_posture_is_the_solution_by_hand_with_the_tool_horizontal_at_the_place_asked():
    solutions = {(0.52, 0.42): (6.48, -143.50, 59.98), (0.50, 0.45): (-1.95, -143.03, 51.08)}
    for (rho, z), degrees in solutions.items():
        for theta in (-3.0, -PI / 4, 0.0, PI / 4, 2.0):
            q = start_posture(theta, rho, z)
            assert np.degrees(q[1:]) == pytest.approx(degrees, abs=0.0051)
            # -theta, but for the 1.35 mm by which the TCP lies beside the arm's plane
            assert wrap(q[0] + theta) == pytest.approx(math.asin(0.00135 / rho), abs=2e-6)
            assert q[1] - q[2] - q[3] == pytest.approx(PI / 2, abs=1e-12)
            np.testing.assert_allclose(tcp(q), (rho * math.cos(theta), rho * math.sin(theta), z), rtol=0, atol=1e-9)


def test_fingers_open_horizontally_and_the_hand_points_radially_outward_at_every_start(arm):
    for theta in (-3.0, -PI / 4, 0.0, PI / 4, 2.0):
        arm.pose(start_posture(theta, 0.52, 0.42))
        state = pybullet.getLinkState(arm.body, 6, computeForwardKinematics=True, physicsClientId=arm.client)
        frame = np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))
        assert abs(frame[2, 0]) < 1e-6  # the fingers open along x
        np.testing.assert_allclose(frame[:, 2], (math.cos(theta), math.sin(theta), 0), rtol=0, atol=3e-3)


def test_inverse_kinematics_is_exact_and_within_the_limits_at_random_reachable_points():
    reached = 0
    for q in np.random.default_rng(1).uniform(-1, 1, (300, 4)) * (PI, 2.41, 2.66, 2.23):
        place = tcp(q)
        if wrap(math.atan2(place[1], place[0]) + q[0]) ** 2 > 0.1:
            continue  # reaches over its own back
        reached += 1
        pitch = PI / 2 - (q[1] - q[2] - q[3])
        for found in (postures(place), postures(place, pitch)):
            assert found.shape[1] == 4
            assert np.all(np.abs(found[:, 1:]) <= (2.41, 2.66, 2.23))
            assert max((math.dist(tcp(one), place) for one in found), default=0) <= 1e-9
        # the posture it came from is among those of its own pitch
        assert min(np.abs(wrap(one - q)).max() for one in found) < 1e-6
    assert reached > 100


def test_every_goal_of_every_stage_is_reachable():
    for theta, rho, z in np.random.default_rng(2).uniform((-PI, 0.3, 0.25), (PI, 0.7, 0.65), (300, 3)):
        assert len(postures(cartesian(theta, rho, z)))


def test_inverse_kinematics_of_an_unreachable_point_is_empty():
    for place in ((1.4, 0, 0.4), (0, 0, 0.8), (0, -1, -0.9)):
        assert postures(place).shape == (0, 4)


def test_wrap_takes_every_angle_to_the_half_open_circle():
    angles = np.linspace(-20, 20, 1001)
    wrapped = wrap(angles)
    assert np.all((wrapped >= -PI) & (wrapped < PI))
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), rtol=0, atol=1e-12)
    assert wrap(PI) == wrap(-PI) == -PI
