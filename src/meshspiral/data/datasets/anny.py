"""Bodies of random people in random poses, any number, from the body model Anny."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from meshspiral.data import posing
from meshspiral.data.cache import code_version
from meshspiral.data.datasets.bodies import Bodies, Size
from meshspiral.data.settings import DataSettings
from meshspiral.data.shapes import (
    DataError,
    Shape,
    ShapeSet,
    SurfacePoints,
    epoch_of,
    nearest_labels,
    registered_shape,
)
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.remesh import closest_points

NEEDED = ("anny", "pymeshlab")
TRIES = 8  # of the poses drawn, that which folds the surface least is taken
DIGITS = 6  # of a coordinate in metres: processors differ in later ones, which would seed remeshing
TESTED = 10  # people for validation, and for the test
AGES = {"adults": (0.5, 0.9), "all": (0.2, 1.0)}  # of Anny: 1/3 is a child, 1 an elder


class Anny(ShapeSet, name="anny"):
    """Bodies of Anny (Brégier et al. 2025) on the templates of `Bodies`, in metres.

    Every body follows from the seed and its name alone: "train_0003_07" is pose 7 of person 3 of
    the people to train on. Validation and test show 10 other people each, whose bodies do not
    depend on `subjects`. In a later epoch, a name to train on stands for another person.

    Args:
        vertices: Size of the template: 1500, or 6890 as in FAUST.
        surface: Number of vertices of the bodies; None for that of the template, whose vertex i is
            then vertex i. Finer bodies are smoother; labels are still vertices of the template.
        subjects: Number of people to train on.
        poses: Number of poses of each person.
        ages: "adults", or "all" for children and elders too.
        people_seed: Seed of all people and poses.

    Raises:
        DataError: Anny or PyMeshLab is not installed.
    """

    up, fresh = "z", True

    class Settings(DataSettings):
        vertices: Size = Field(description="vertices of the template")
        surface: Size | None = Field(
            description="vertices of the bodies, before remeshing; null: as the template"
        )
        subjects: int = Field(ge=1, description="number of people to train on")
        poses: int = Field(ge=1, description="number of poses of each person")
        ages: Literal["adults", "all"] = Field(
            description="adults, or all: children and elders too"
        )
        people_seed: int = Field(ge=0, description="seed of people and poses")

    def __init__(
        self,
        vertices: int,
        subjects: int,
        poses: int,
        ages: str,
        people_seed: int,
        surface: int | None = None,
    ):
        if missing := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
            raise DataError(f"data=anny needs {', '.join(missing)}: pip install -e '.[anny]'")
        self._size, self._ages, self._seed = surface or vertices, ages, people_seed
        self._subjects = subjects
        self.template = Bodies(vertices).template
        self._bodies = Bodies(self._size).template
        people = {"train": subjects, "val": TESTED, "test": TESTED}
        self._numbers = {
            f"{split}_{person:04d}_{pose:02d}": (i, person, pose)
            for i, split in enumerate(people)
            for person in range(people[split])
            for pose in range(poses)
        }
        self.names = {
            split: [name for name in self._numbers if name.startswith(split)] for split in people
        }

    def load(self, name: str) -> Shape:
        body, epoch = epoch_of(name)
        if body not in self._numbers:
            raise DataError(
                f"no body is named {name!r}; the first is {next(iter(self._numbers))!r}"
            )
        split, person, pose = self._numbers[body]
        person += epoch * self._subjects
        traits = draw_person(np.random.default_rng([self._seed, split, person]), self._ages)
        # pose + 1, since NumPy takes a seed that ends with 0 for the one without it
        rng = np.random.default_rng([self._seed, split, person, pose + 1])
        tried = []
        for _ in range(TRIES):
            vertices = self._surface.of(body_model().posed(traits, posing.draw_pose(rng)))
            vertices = vertices.round(DIGITS)
            mesh = Mesh(vertices, self._bodies.faces, name)
            tried.append((folded_faces(mesh), mesh))
            if tried[-1][0] == 0:
                break
        mesh = min(tried, key=lambda each: each[0])[1]
        if self._labels is None:
            return registered_shape(mesh, self.template)
        return Shape(mesh, *self._labels)

    def stamp(self, name: str) -> str:
        code = code_version(posing, sys.modules[__name__])
        sizes = f"{len(self.template.vertices)} {self._size}"
        return f"{name} {sizes} {self._ages} {self._seed} {version('anny')} {code}"

    @cached_property
    def _labels(self) -> tuple[np.ndarray, int, SurfacePoints] | None:
        """The fields of `Shape` after the mesh; None if the bodies have the template's vertices."""
        template, bodies = self.template, self._bodies
        if len(template.vertices) == self._size:
            return None
        face, weights, _ = closest_points(template, bodies.vertices, bodies.vertex_normals)
        corners = template.faces[face].astype(np.int64)
        labels = nearest_labels(template, corners, interpolate(template.vertices, corners, weights))
        return labels, len(template.vertices), SurfacePoints(corners, weights)

    @cached_property
    def _surface(self) -> Surface:
        return Surface(self._size)


def draw_person(rng: np.random.Generator, ages: str) -> dict[str, float]:
    """Draw Anny's parameters of a person, each in 0..1."""
    origin = rng.dirichlet([1.0, 1.0, 1.0])
    return {
        "gender": float(np.clip(rng.integers(2) + 0.1 * rng.normal(), 0, 1)),
        "age": float(rng.uniform(*AGES[ages])),
        "muscle": float(rng.uniform(0.2, 0.95)),
        "weight": float(rng.uniform(0.15, 0.95)),
        "height": float(rng.uniform(0.2, 0.65)),
        "proportions": float(rng.uniform(0.25, 0.85)),
        "cupsize": float(rng.uniform(0.25, 0.75)),
        "firmness": float(rng.uniform(0.25, 0.75)),
        "african": float(origin[0]),
        "asian": float(origin[1]),
        "caucasian": float(origin[2]),
    }


def folded_faces(mesh: Mesh) -> int:
    """The number of faces that intersect other faces of the mesh."""
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces))
    meshes.compute_selection_by_self_intersections_per_face()
    return int(meshes.current_mesh().selected_face_number())


class Surface:
    """The vertices of `Bodies` as points in faces of Anny's surface.

    The surface lacks the insides of mouth and eyes, so that it is closed.

    Args:
        vertices: 1500 or 6890.
    """

    def __init__(self, vertices: int):
        path = Path(__file__).parents[1] / "assets" / "anny_surface.npz"
        with np.load(path, allow_pickle=False) as file:
            self._kept = file["kept"].astype(np.int64)
            self._corners = file["faces"].astype(np.int64)[
                file[f"face_{vertices}"].astype(np.int64)
            ]
            self._weights = file[f"weights_{vertices}"].astype(np.float64)

    def of(self, vertices: np.ndarray) -> np.ndarray:
        """The vertices of a body, float64 [V, 3], from those of Anny, [A, 3]; the feet at z = 0."""
        kept = vertices[self._kept]
        centred = kept - [kept[:, 0].mean(), kept[:, 1].mean(), kept[:, 2].min()]
        return np.einsum("vc,vcd->vd", self._weights, centred[self._corners])


class BodyModel:
    """Anny, skinned by the mean of linear blending and of dual quaternions."""

    def __init__(self) -> None:
        import anny

        self._model: Any = anny.Anny(
            rig="anny",
            topology="notoes",
            phenotype_blendshapes="original",
            skinning_method="lbs",
            phenotypes="all",
        )

    def posed(self, traits: dict[str, float], pose: dict[str, float]) -> np.ndarray:
        """The vertices of a person in a pose, float64 [A, 3]."""
        import torch

        resting = self._model(phenotype_kwargs=traits)["bone_poses"][0, :, :3, 3].numpy()
        joints = dict(zip(self._model.bone_labels, resting.astype(np.float64), strict=True))
        rotations = {}
        for bone, matrix in posing.bone_rotations(pose, joints).items():
            rotations[bone] = torch.eye(4, dtype=torch.float64)[None].clone()
            rotations[bone][0, :3, :3] = torch.from_numpy(matrix)
        skinned = []
        for method in ("lbs", "dqs"):
            self._model.set_skinning_method(method)
            posed = self._model(pose_parameters=rotations, phenotype_kwargs=traits)
            skinned.append(posed["vertices"][0].numpy().astype(np.float64))
        return np.mean(skinned, axis=0)


@cache
def body_model() -> BodyModel:
    """Anny, once in every process. Its first start on a machine takes minutes, later seconds."""
    return BodyModel()
