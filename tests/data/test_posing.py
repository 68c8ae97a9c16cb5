"""Poses: angles within their ranges, and rotations that do what the angles say."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.data.posing import (
    RANGES,
    X,
    Y,
    Z,
    about,
    arm_rotations,
    bone_rotations,
    draw_pose,
    leg_rotations,
    shortest_turn,
)

REST = {name: limits.rest for name, limits in RANGES.items()}


def joints(side: str) -> dict[str, np.ndarray]:
    """An arm that hangs outwards, slightly bent to the front, with the palm to the body."""
    sign = 1.0 if side == "L" else -1.0
    places = {
        "upperarm01": (0.2, 0.0, 1.4),
        "lowerarm01": (0.4, 0.0, 1.2),
        "wrist": (0.58, -0.05, 1.0),
        "finger2-1": (0.62, -0.10, 0.93),
        "finger5-1": (0.64, -0.02, 0.92),
    }
    return {name: np.array([sign * x, y, z]) for name, (x, y, z) in places.items()}


BODY = {f"{name}.{side}": place for side in "LR" for name, place in joints(side).items()}


def test_angles_lie_within_their_ranges_and_use_them():
    rng = np.random.default_rng(0)
    drawn = [draw_pose(rng) for _ in range(400)]
    for name, (least, rest, most) in RANGES.items():
        angles = np.array([pose[name] for pose in drawn])
        assert angles.min() >= least and angles.max() <= most
        assert (angles < rest).mean() < 0.7 and (angles > rest).mean() > 0.3
        assert np.ptp(angles) > 0.7 * (most - least)
    assert draw_pose(np.random.default_rng(5)) == draw_pose(np.random.default_rng(5))


def test_rotations_are_rotations():
    for matrix in bone_rotations(draw_pose(np.random.default_rng(1)), BODY).values():
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix) == pytest.approx(1)


def direction_of_upper_arm(pose: dict[str, float], side: str) -> np.ndarray:
    sign = 1.0 if side == "L" else -1.0
    angles = {key[:-2]: value for key, value in pose.items() if key.endswith(side)}
    found = arm_rotations(angles, joints(side), sign)
    chain = found["clavicle"] * found["shoulder01"] * found["upperarm01"]
    arm = joints(side)["lowerarm01"] - joints(side)["upperarm01"]
    return chain.apply(arm / np.linalg.norm(arm))


@pytest.mark.parametrize("side, sign", [("L", 1.0), ("R", -1.0)])
@pytest.mark.parametrize(
    "raised, forward, expected",
    [(0, 0, X), (80, 0, None), (0, 90, -Y), (-75, 0, None)],
)
def test_the_upper_arm_points_where_its_angles_say(side, sign, raised, forward, expected):
    pose = REST | {f"arm_raised.{side}": raised, f"arm_forward.{side}": forward}
    if expected is None:
        expected = np.cos(np.radians(raised)) * X + np.sin(np.radians(raised)) * Z
    expected = expected * [sign, 1, 1]
    np.testing.assert_allclose(direction_of_upper_arm(pose, side), expected, atol=1e-12)


def test_the_elbow_bends_by_its_angle():
    at = joints("L")
    upper, lower = at["lowerarm01"] - at["upperarm01"], at["wrist"] - at["lowerarm01"]
    for angle in (0, 40, 130):
        angles = {name[:-2]: value for name, value in REST.items() if name.endswith("L")}
        bent = arm_rotations(angles | {"elbow": angle}, at, 1.0)["lowerarm01"].apply(lower)
        cosine = bent @ upper / np.linalg.norm(bent) / np.linalg.norm(upper)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) == pytest.approx(angle, abs=1e-5)


def test_legs_swing_to_the_front_and_outwards_and_knees_bend_backwards():
    angles = {name[:-2]: value for name, value in REST.items() if name.endswith("L")}
    down = -Z
    front = leg_rotations(angles | {"hip_forward": 90}, 1.0)["upperleg01"].apply(down)
    np.testing.assert_allclose(front, -Y, atol=1e-12)
    for sign in (1.0, -1.0):
        out = leg_rotations(angles | {"hip_outward": 34}, sign)["upperleg01"].apply(down)
        assert out[0] * sign == pytest.approx(np.sin(np.radians(30))) and out[1] == 0
    back = leg_rotations(angles | {"knee": 94}, 1.0)["lowerleg01"].apply(down)
    np.testing.assert_allclose(back, Y, atol=1e-12)


def test_left_and_right_mirror_each_other():
    pose = draw_pose(np.random.default_rng(3))
    pose |= {name: RANGES[name].rest for name in RANGES if "." not in name}
    pose |= {name.replace(".L", ".R"): pose[name] for name in pose if name.endswith(".L")}
    found, mirror = bone_rotations(pose, BODY), np.diag([-1.0, 1.0, 1.0])
    for bone in (name for name in found if name.endswith(".L")):
        right = found[bone.replace(".L", ".R")]
        np.testing.assert_allclose(mirror @ found[bone] @ mirror, right, atol=1e-9, err_msg=bone)


def test_the_shortest_turn_between_opposite_directions():
    for a in (X, Y, Z):
        np.testing.assert_allclose(shortest_turn(a, -a).apply(a), -a, atol=1e-12)
        np.testing.assert_allclose(shortest_turn(a, a).as_matrix(), np.eye(3))
    np.testing.assert_allclose(about(Z, 90).apply(X), Y, atol=1e-12)
