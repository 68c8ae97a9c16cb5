"""Training shapes damaged as scans are: noise, warps, bumps, holes, missing faces and parts."""

from __future__ import annotations

import sys

import numpy as np
from trimesh.graph import connected_component_labels

from meshspiral.data.cache import code_version
from meshspiral.data.settings import DamageSettings
from meshspiral.data.shapes import Shape, ShapeSet, SurfacePoints, epoch_of
from meshspiral.geometry import holes
from meshspiral.geometry.digest import derived_seed
from meshspiral.geometry.mesh import Mesh, used_vertices

SMALLEST_HOLE = 0.02  # radius over the size of the shape
WAVES = 4  # of a warp
WAVELENGTHS = (0.1, 0.8)  # over the size of the shape
RIPPLES = 24  # waves of bumps
RIPPLE_LENGTHS = (0.03, 0.15)  # over the size of the shape
KEPT = (0.35, 0.9)  # share of the vertices on the kept side of a cut
EXTREMITY = (0.06, 0.16)  # radius of what is cut off a hand, a foot or the head, over the size
LEAST = 0.25  # share of the vertices that must be left


class Damaged(ShapeSet):
    """The shapes of another data set, those to train on damaged; validation and test as they are.

    The damage of a shape follows from the seed and its name. Labels remain those of the vertices
    that are left. Small holes are then closed, as they are before a mesh is matched. A damaged mesh
    knows the area of the complete surface, up to the settings' `size`.

    Args:
        base: The other data set.
        settings: What damage.
    """

    fresh = True

    def __init__(self, base: ShapeSet, settings: DamageSettings) -> None:
        self.base, self._settings = base, settings
        self.template, self.up, self.names = base.template, base.up, base.names
        self._damaged = set(base.names["train"])

    def prepare(self, names: list[str]) -> None:
        self.base.prepare(names)

    def load(self, name: str) -> Shape:
        original, _ = epoch_of(name)
        shape = self.base.load(name if self.base.fresh else original)
        if original not in self._damaged:
            return shape
        rng = np.random.default_rng(derived_seed(self._settings.seed, "damage", name))
        return damaged(shape, self._settings, rng)

    def stamp(self, name: str) -> str | None:
        stamp = self.base.stamp(name)
        if stamp is None or name not in self._damaged:
            return stamp
        return f"{stamp}|{self._settings!r}|{code_version(holes, sys.modules[__name__])}"


def damaged(shape: Shape, settings: DamageSettings, rng: np.random.Generator) -> Shape:
    """A damaged copy of a shape, without the vertices that lose their faces."""
    mesh = shape.mesh
    vertices = mesh.vertices
    if settings.warp:
        vertices = warped(vertices, rng.uniform(0, settings.warp), mesh.size, rng)
    if settings.bumps:
        vertices = bumpy(Mesh(vertices, mesh.faces), rng.uniform(0, settings.bumps), rng)
    noise = rng.uniform(0, settings.noise) * mesh.size
    vertices = vertices + rng.normal(scale=noise, size=vertices.shape)
    complete_area = (mesh.size * np.exp(rng.uniform(-settings.size, settings.size))) ** 2
    faces = mesh.faces
    if rng.random() < settings.share:
        lost = np.zeros(len(vertices), dtype=bool)
        if rng.random() < settings.cut:
            lost |= beyond_plane(vertices, rng)
        for _ in range(rng.integers(settings.holes + 1)):
            radius = rng.uniform(min(SMALLEST_HOLE, settings.hole_radius), settings.hole_radius)
            lost |= around_point(vertices, radius * mesh.size, rng)
        if settings.extremities and rng.random() < settings.extremities:
            lost |= at_extremity(vertices, rng.uniform(*EXTREMITY) * mesh.size, rng)
        kept = ~lost[faces].any(axis=1)
        kept &= rng.random(len(faces)) >= rng.uniform(0, settings.missing)
        if settings.component and rng.random() < settings.component:
            kept[kept] = without_a_component(faces[kept], rng)
        if len(np.unique(faces[kept])) >= LEAST * len(vertices):
            faces = faces[kept]
    used, faces = used_vertices(faces)
    points = shape.points and SurfacePoints(*(array[used] for array in shape.points))
    left = holes.close_holes(Mesh(vertices[used], faces, mesh.name, float(complete_area)))
    return Shape(left, shape.labels[used], shape.template_size, points)


def warped(
    points: np.ndarray, amplitude: float, size: float, rng: np.random.Generator
) -> np.ndarray:
    """Points in a smoothly warped space, as the proportions and clothes of people differ.

    The displacement is a sum of plane waves. Its derivative has a standard deviation of about
    9 times the amplitude, so a length changes by up to a fifth or so at an amplitude of 0.02.

    Args:
        points: Points, float [P, 3].
        amplitude: Length of each wave's displacement, over its wavelength.
        size: The unit of WAVELENGTHS, in the unit of the points.
        rng: Draws the waves.

    Returns:
        The moved points, float [P, 3].
    """
    lengths = random_lengths(WAVES, WAVELENGTHS, size, rng)
    along = unit_vectors(WAVES, rng)
    return points + plane_waves(points, lengths, rng) @ (amplitude * lengths[:, None] * along)


def bumpy(mesh: Mesh, slope: float, rng: np.random.Generator) -> np.ndarray:
    """The vertices of a mesh, moved along their normals, as by hair, muscles and folds of clothes.

    The height is a sum of plane waves. A wave of amplitude a and length l has a gradient of
    (2 pi a / l) cos(...), of which a surface that is not aligned with it sees two thirds of the
    square. So n waves with amplitudes c l have the slope 2 pi c sqrt(n / 3), as root mean square.

    Args:
        mesh: The surface.
        slope: Root mean square of the tangents of the angles by which normals turn.
        rng: Draws the waves.

    Returns:
        The moved vertices, float [V, 3].
    """
    lengths = random_lengths(RIPPLES, RIPPLE_LENGTHS, mesh.size, rng)
    amplitudes = slope / (2 * np.pi * np.sqrt(RIPPLES / 3)) * lengths
    heights = plane_waves(mesh.vertices, lengths, rng) @ amplitudes
    return mesh.vertices + heights[:, None] * mesh.vertex_normals


def random_lengths(
    count: int, between: tuple[float, float], size: float, rng: np.random.Generator
) -> np.ndarray:
    """Wavelengths with uniform logarithms, float [count], in the unit of `size`."""
    return size * np.exp(rng.uniform(*np.log(between), size=count))


def plane_waves(points: np.ndarray, lengths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sine waves of these lengths in random directions, float [P, waves]."""
    towards = unit_vectors(len(lengths), rng)
    phases = rng.uniform(0, 2 * np.pi, size=len(lengths))
    return np.sin(2 * np.pi * points @ (towards / lengths[:, None]).T + phases)


def unit_vectors(count: int, rng: np.random.Generator) -> np.ndarray:
    """Random directions, float [count, 3]."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def beyond_plane(vertices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The vertices on one side of a random plane, bool [V]: 1 - KEPT of them."""
    normal = rng.normal(size=3)
    heights = vertices @ normal
    return heights > np.quantile(heights, rng.uniform(*KEPT))


def around_point(vertices: np.ndarray, radius: float, rng: np.random.Generator) -> np.ndarray:
    """The vertices in a ball around a random one, bool [V]."""
    centre = vertices[rng.integers(len(vertices))]
    return np.linalg.norm(vertices - centre, axis=1) < radius


def at_extremity(vertices: np.ndarray, radius: float, rng: np.random.Generator) -> np.ndarray:
    """The vertices in a ball around the one that is farthest from a random one, bool [V]."""
    start = vertices[rng.integers(len(vertices))]
    end = vertices[np.linalg.norm(vertices - start, axis=1).argmax()]
    return np.linalg.norm(vertices - end, axis=1) < radius


def without_a_component(faces: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The faces but those of a random component, which is not the largest; all if there is one.

    Args:
        faces: int [F, 3].
        rng: Draws the component.

    Returns:
        bool [F].
    """
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)  # two edges connect a face's corners
    labels = connected_component_labels(edges, node_count=faces.max(initial=0) + 1)
    component = labels[faces[:, 0]]
    present, sizes = np.unique(component, return_counts=True)
    if len(present) < 2:
        return np.ones(len(faces), dtype=bool)
    return component != rng.choice(np.delete(present, sizes.argmax()))
