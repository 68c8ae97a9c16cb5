"""Random poses of a human body: angles of the joints, and the rotations of bones that make them.

The body stands in x (its left), y (its back) and z (up). Angles are in degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

X, Y, Z = np.eye(3)
Joints = Mapping[str, np.ndarray]  # name of a bone: where it begins, float64 [3]


class Range(NamedTuple):
    """The least angle of a joint, its angle at rest, and its largest."""

    least: float
    rest: float
    most: float


# chosen by us, within what adults can do
TRUNK = {
    "lean_forward": Range(-15, 0, 50),  # of the whole body at the hips
    "lean_right": Range(-10, 0, 10),
    "spine_forward": Range(-25, 0, 50),
    "spine_left": Range(-28, 0, 28),
    "spine_turn": Range(-40, 0, 40),
    "head_forward": Range(-35, 0, 40),
    "head_left": Range(-28, 0, 28),
    "head_turn": Range(-55, 0, 55),
}
SIDE = {  # of the left and of the right limbs
    "arm_raised": Range(-75, -50, 80),  # over the horizontal: -90 hangs down
    "arm_forward": Range(-30, 0, 100),  # 0 points sideways, 90 to the front
    "arm_turn": Range(-60, 0, 60),  # inwards
    "elbow": Range(0, 15, 130),
    "forearm_turn": Range(-60, 0, 60),
    "wrist": Range(-40, 0, 40),
    "fingers": Range(0, 15, 80),
    "hip_forward": Range(-22, 0, 95),
    "hip_outward": Range(-6, 4, 38),
    "hip_turn": Range(-28, 0, 28),
    "knee": Range(0, 4, 115),
    "ankle": Range(-22, 0, 28),  # toes up
}
RANGES = TRUNK | {f"{name}.{side}": limits for side in "LR" for name, limits in SIDE.items()}
SPINE = {"spine05": 0.15, "spine04": 0.25, "spine03": 0.25, "spine02": 0.2, "spine01": 0.15}
NECK = {"neck01": 0.25, "neck02": 0.25, "neck03": 0.2, "head": 0.3}


def draw_pose(rng: np.random.Generator) -> dict[str, float]:
    """Draw an angle for every joint of RANGES.

    How far a pose is from rest is drawn first, so that there are calm poses and wide ones. Then
    each angle is drawn from both sides of its rest: half a normal distribution, whose standard
    deviation is up to 0.6 of the range on that side.
    """
    spread = rng.uniform(0.1, 0.6)
    pose = {}
    for name, (least, rest, most) in RANGES.items():
        draw = spread * rng.normal()
        angle = rest + draw * (most - rest if draw > 0 else rest - least)
        pose[name] = float(np.clip(angle, least, most))
    if rng.random() < 0.5:  # both legs bend alike, as in squatting
        for name in ("hip_forward", "knee", "ankle"):
            pose[f"{name}.R"] = pose[f"{name}.L"]
    return pose


def bone_rotations(pose: Mapping[str, float], joints: Joints) -> dict[str, np.ndarray]:
    """The rotation of each bone relative to the one before it.

    Args:
        pose: An angle for every joint of RANGES.
        joints: Where the bones begin in the rest position.

    Returns:
        float64 [3, 3] for each bone that turns, in the axes of the body.
    """
    forward, right = about(X, pose["lean_forward"]), about(Y, -pose["lean_right"])
    found = {"root": forward * right}
    for part, bones in (("spine", SPINE), ("head", NECK)):
        for bone, share in bones.items():
            turn, bend, side = (pose[f"{part}_{way}"] for way in ("turn", "forward", "left"))
            found[bone] = about(Z, share * turn) * about(X, share * bend) * about(Y, share * side)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        angles = {name: pose[f"{name}.{side}"] for name in SIDE}
        at = {name: joints[f"{name}.{side}"] for name in ARM}
        limbs = arm_rotations(angles, at, sign) | leg_rotations(angles, sign)
        found |= {f"{bone}.{side}": rotation for bone, rotation in limbs.items()}
    return {bone: rotation.as_matrix() for bone, rotation in found.items()}


ARM = ("upperarm01", "lowerarm01", "wrist", "finger2-1", "finger5-1")


def arm_rotations(angles: Mapping[str, float], joints: Joints, sign: float) -> dict[str, Rotation]:
    """Collar bone, shoulder, arm and fingers of one side; `sign` is 1 left and -1 right."""
    upper = unit(joints["lowerarm01"] - joints["upperarm01"])
    lower = unit(joints["wrist"] - joints["lowerarm01"])
    knuckles = sign * unit(joints["finger5-1"] - joints["finger2-1"])
    raised, forward = np.radians([angles["arm_raised"], angles["arm_forward"]])
    direction = np.array(
        [
            sign * np.cos(raised) * np.cos(forward),
            -np.cos(raised) * np.sin(forward),
            np.sin(raised),
        ]
    )
    swing = shortest_turn(upper, direction)
    # the collar bone moves with a raised arm
    collar = part(swing, 0.1 + 0.12 * np.clip((angles["arm_raised"] + 50) / 120, 0, 1))
    shoulder = part(swing, 0.16)
    twist = about(upper, -0.5 * sign * angles["arm_turn"])
    hinge = np.cross(upper, lower)
    bent = np.degrees(np.arctan2(np.linalg.norm(hinge), upper @ lower))  # at rest
    turn = about(lower, -sign * angles["forearm_turn"])
    found = {
        "clavicle": collar,
        "shoulder01": shoulder,
        "upperarm01": (collar * shoulder).inv() * swing * twist,
        "upperarm02": twist,
        "lowerarm01": about(hinge, angles["elbow"] - bent),
        "lowerarm02": part(turn, 0.6),
        "wrist": part(turn, 0.4) * about(knuckles, angles["wrist"]),
    }
    for finger in range(2, 6):
        for joint, share in ((1, 1.0), (2, 1.2), (3, 0.8)):
            curl = angles["fingers"] * share * (0.8 + 0.1 * finger)
            found[f"finger{finger}-{joint}"] = about(knuckles, 12 - curl)  # 12 degrees at rest
    return found


def leg_rotations(angles: Mapping[str, float], sign: float) -> dict[str, Rotation]:
    """Hip, knee and ankle of one side."""
    turn = about(Z, 0.5 * sign * angles["hip_turn"])
    at_rest = SIDE["hip_outward"].rest
    swing = about(X, -angles["hip_forward"]) * about(Y, -sign * (angles["hip_outward"] - at_rest))
    return {
        "upperleg01": swing * turn,
        "upperleg02": turn,
        "lowerleg01": about(X, angles["knee"] - SIDE["knee"].rest),
        "foot": about(X, -angles["ankle"]),
    }


def about(axis: np.ndarray, degrees: float) -> Rotation:
    """The rotation about an axis, counter-clockwise as seen from its tip."""
    return Rotation.from_rotvec(np.radians(degrees) * unit(np.asarray(axis, float)))


def part(rotation: Rotation, share: float) -> Rotation:
    """A share of a rotation, about the same axis."""
    return Rotation.from_rotvec(share * rotation.as_rotvec())


def shortest_turn(a: np.ndarray, b: np.ndarray) -> Rotation:
    """The rotation by the least angle that takes direction a to direction b, both float64 [3]."""
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        across = np.cross(a, X if abs(a[0]) < 0.9 else Y)
        return Rotation.identity() if cosine > 0 else about(across, 180)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine))


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
