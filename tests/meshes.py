"""Small meshes for tests."""

from __future__ import annotations

import numpy as np
import trimesh

from meshspiral.geometry.mesh import Mesh


def lattice(rows: int, columns: int) -> Mesh:
    """A regular triangular lattice in the plane z = 0, facing +z; vertex (i, j) is
    i * columns + j."""
    i, j = np.mgrid[:rows, :columns]
    x, y = j + 0.5 * i, i * np.sqrt(3) / 2
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    a = (i * columns + j)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([a, a + 1, a + columns], 1), np.stack([a + 1, a + columns + 1, a + columns], 1)]
    )
    return Mesh(vertices, faces)


def bumpy_sphere(seed: int = 0, subdivisions: int = 2, bump: float = 0.25) -> Mesh:
    """A closed surface of genus 0 without symmetries."""
    rng = np.random.default_rng(seed)
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    x = np.asarray(sphere.vertices)
    radius = (
        1
        + bump
        * sum(
            rng.normal() * np.sin(x @ rng.normal(size=3) * 2 + rng.uniform(0, 6)) for _ in range(6)
        )
        / 6
    )
    return Mesh(x * radius[:, None] * [1.0, 0.8, 1.3], sphere.faces)


def torus(rows: int = 9, columns: int = 13) -> Mesh:
    """A torus whose vertices all have valence 6."""
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    u, v = 2 * np.pi * i / rows, 2 * np.pi * j / columns
    r = 1 + 0.4 * np.cos(u)
    vertices = np.stack([r * np.cos(v), r * np.sin(v), 0.4 * np.sin(u)], -1).reshape(-1, 3)

    def at(di, dj):
        return (((i + di) % rows) * columns + (j + dj) % columns).ravel()

    faces = np.concatenate(
        [np.stack([at(0, 0), at(0, 1), at(1, 0)], 1), np.stack([at(0, 1), at(1, 1), at(1, 0)], 1)]
    )
    return Mesh(vertices, faces)


def punctured(mesh: Mesh, share: float, seed: int = 0) -> Mesh:
    """The mesh without a random share of its faces, with holes, bow ties and isolated vertices."""
    keep = np.random.default_rng(seed).random(len(mesh.faces)) >= share
    return Mesh(mesh.vertices, mesh.faces[keep])


def union(*meshes: Mesh) -> Mesh:
    """The meshes side by side, as components of one mesh."""
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return Mesh(
        np.concatenate([m.vertices + 5.0 * i for i, m in enumerate(meshes)]),
        np.concatenate([m.faces + offset for m, offset in zip(meshes, offsets, strict=False)]),
    )


def bow_tie() -> Mesh:
    """Two triangles with vertex 0 as their only common vertex."""
    vertices = [[0, 0, 0], [1, 0.5, 0], [1, -0.5, 0], [-1.2, -0.5, 0], [-1.2, 0.5, 0.1]]
    return Mesh(vertices, [[0, 2, 1], [0, 4, 3]])


def two_cones() -> Mesh:
    """Two closed fans of triangles with vertex 0 as their only common vertex."""
    rng = np.random.default_rng(3)
    rings = []
    for side in (1, -1):
        angle = np.sort(rng.uniform(0, 2 * np.pi, 5)) * side
        ring = np.stack([np.cos(angle), np.sin(angle), np.full(5, side)], 1)
        rings.append(ring * rng.uniform(0.8, 1.2, (5, 1)))
    vertices = np.concatenate([[[0.0, 0.0, 0.0]], *rings])
    k = np.arange(5)
    faces = [np.stack([np.zeros(5, int), first + k, first + (k + 1) % 5], 1) for first in (1, 6)]
    return Mesh(vertices, np.concatenate(faces))


def random_meshes() -> dict[str, Mesh]:
    """Closed and open meshes, with handles, holes, small components and bow ties."""
    sphere = bumpy_sphere(1)
    triangle = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    tetrahedron = Mesh(
        [[0, 0, 0], [1, 0, 0], [0, 1.2, 0], [0, 0, 1.4]],
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
    )
    return {
        "lattice": lattice(7, 8),
        "sphere": sphere,
        "torus": torus(),
        "holes": punctured(sphere, 0.15),
        "rags": punctured(torus(), 0.45, seed=2),
        "parts": union(triangle, tetrahedron, bumpy_sphere(2, 1), bow_tie(), two_cones()),
    }


def icosphere(subdivisions=3):
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(sphere.vertices, sphere.faces)


def two_boxes(gap: float) -> Mesh:
    """Two boxes of width 0.3 side by side along x, with a gap between them; the size is 1.2."""
    boxes = [
        trimesh.creation.box((0.3, 0.5, 0.3)).apply_translation([side * (0.15 + gap / 2), 0, 0])
        for side in (-1, 1)
    ]
    both = trimesh.util.concatenate(boxes).subdivide_to_size(0.08)
    return Mesh(both.vertices, both.faces)
