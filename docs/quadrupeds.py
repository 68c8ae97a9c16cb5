"""Write 20 labelled meshes of a four-legged animal, to try fine-tuning on other shapes.

    python docs/quadrupeds.py outputs/quadrupeds

Five animals differ in their proportions; each stands in four poses. All have the connectivity and
the order of vertices of template.ply (`data.labels=identity`). The files are
animal_<0..4>_pose_<0..3>.ply.
"""

import sys
from pathlib import Path

import numpy as np
import pyvista as pv
import trimesh
from scipy.spatial.transform import Rotation

from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.remesh import remesh

VERTICES, GRID = 1500, 0.025
BLEND = 0.06  # length over which two parts of the body are smoothed into each other
# name: (parent, start, end, radius at the start, radius at the end); x is forward, y up
BONES = {
    "trunk": (None, (-0.45, 1.0, 0), (0.4, 1.0, 0), 0.24, 0.26),
    "neck": ("trunk", (0.45, 1.1, 0), (0.8, 1.55, 0), 0.17, 0.11),
    "head": ("neck", (0.8, 1.55, 0), (1.15, 1.4, 0), 0.12, 0.07),
    "tail": ("trunk", (-0.65, 1.1, 0), (-0.95, 0.6, 0), 0.06, 0.04),
}
for side, z in {"left": 0.16, "right": -0.16}.items():
    BONES[f"{side} ear"] = "head", (0.8, 1.63, z / 3), (0.76, 1.8, z / 2), 0.04, 0.025
    for end, x in {"fore": 0.4, "hind": -0.45}.items():
        back = 0.08 if end == "hind" else 0.0
        knee, foot = (x - back, 0.5, z), (x - back / 2, 0.03, z)
        BONES[f"{side} {end} thigh"] = "trunk", (x, 0.95, z), knee, 0.15, 0.08
        BONES[f"{side} {end} shank"] = f"{side} {end} thigh", knee, foot, 0.075, 0.05


def distances(points: np.ndarray) -> np.ndarray:
    """The signed distance of points [P, 3] to the capsule of every bone, [P, B]."""
    columns = []
    for _, start, end, first, last in BONES.values():
        axis = np.subtract(end, start)
        along = ((points - start) @ axis / (axis @ axis)).clip(0, 1)
        gap = np.linalg.norm(points - start - along[:, None] * axis, axis=1)
        columns.append(gap - first - along * (last - first))
    return np.stack(columns, 1)


def rest_shape() -> Mesh:
    """The template: the smooth union of all capsules, remeshed."""
    low, high = np.array([-1.2, -0.2, -0.6]), np.array([1.4, 2.0, 0.6])
    size = np.ceil((high - low) / GRID).astype(int)
    grid = pv.ImageData(dimensions=size, spacing=(GRID,) * 3, origin=low)
    field = -BLEND * np.log(np.exp(-distances(grid.points) / BLEND).sum(axis=1))
    surface = grid.contour([0.0], scalars=field)
    faces = surface.faces.reshape(-1, 4)[:, [1, 2, 3]]
    solid = trimesh.Trimesh(surface.points, faces)
    trimesh.repair.fix_normals(solid)
    return remesh(Mesh(solid.vertices, solid.faces, "template"), VERTICES).mesh


def deformed(rest: np.ndarray, animal: np.random.Generator, pose: np.random.Generator):
    """The vertices of an animal in a pose, by linear blend skinning of rest vertices [V, 3]."""
    weights = np.exp(-distances(rest) / 0.05)
    weights /= weights.sum(axis=1, keepdims=True)
    maps, result = {}, np.zeros_like(rest)
    stretch = {n.split()[-1]: animal.uniform([0.75, 0.75], [1.3, 1.3]) for n in BONES}
    for i, (name, (parent, start, end, *_)) in enumerate(BONES.items()):
        axis = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
        along, across = stretch[name.split()[-1]]
        scale = across * np.eye(3) + (along - across) * np.outer(axis, axis)
        bend = 0.12 if parent is None or "ear" in name else np.array([0.15, 0.15, 0.4])
        turn = Rotation.from_rotvec(pose.normal(size=3) * bend).as_matrix()
        if parent is None:
            joint, frame = np.array(start), turn
        else:
            above, offset, linear = maps[parent]
            joint, frame = linear @ np.array(start) + offset, above @ turn
        linear = frame @ scale
        maps[name] = frame, joint - linear @ np.array(start), linear
        result += weights[:, i : i + 1] * (rest @ linear.T + maps[name][1])
    return result


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rest = rest_shape()
    shapes = {"template": rest.vertices}
    for animal in range(5):
        for pose in range(4):
            body, stance = np.random.default_rng(animal), np.random.default_rng([animal, pose])
            shapes[f"animal_{animal}_pose_{pose}"] = deformed(rest.vertices, body, stance)
    for name, vertices in shapes.items():
        trimesh.Trimesh(vertices, rest.faces, process=False).export(folder / f"{name}.ply")
    print(f"{len(shapes) - 1} meshes and a template of {len(rest.vertices)} vertices in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
