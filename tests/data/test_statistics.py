"""Statistics of meshes: closed forms on small ones, and remeshed shapes compared to originals."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.data.damaged import Damaged
from meshspiral.data.settings import DamageSettings
from meshspiral.data.shapes import ShapeSet, registered_shape
from meshspiral.data.sources import open_shapes
from meshspiral.data.statistics import (
    hausdorff_distance,
    labelled_edges,
    mean_statistics,
    mesh_statistics,
    shared_edges,
)
from meshspiral.geometry.mesh import Mesh
from tests.helpers import composed
from tests.meshes import bow_tie, bumpy_sphere, lattice, punctured, torus, union

TETRAHEDRON = Mesh(
    np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float),
    [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
)


class OneMesh(ShapeSet):
    """A data set of one mesh, which is its own template."""

    def __init__(self, mesh):
        self.template = mesh
        self.names = {"train": ["a"], "val": [], "test": []}

    def load(self, name):
        return registered_shape(self.template, self.template)


def statistics(mesh):
    shapes = OneMesh(mesh)
    return mesh_statistics(shapes.load("a"), None, shapes, "a")


def test_of_a_regular_tetrahedron():
    found = statistics(TETRAHEDRON)
    assert found[:6] == (4, 4, 1, True, True, 0)
    assert found.edge_variation == pytest.approx(0, abs=1e-12)
    assert found.min_angle == pytest.approx(60)
    assert found.as_source is found.source_distance is found.label_distance is None
    assert found.shared_edges is None


def test_genus_is_summed_over_components_and_undefined_with_a_boundary():
    assert statistics(torus()).genus == 1
    both = statistics(union(torus(), bumpy_sphere()))
    assert (both.components, both.closed, both.genus) == (2, True, 1)
    sheet = statistics(lattice(4, 4))
    assert (sheet.manifold, sheet.closed, sheet.genus) == (True, False, None)
    assert not statistics(bow_tie()).manifold


def test_vertices_on_no_face_are_no_components():
    sphere = bumpy_sphere()
    isolated = Mesh(np.concatenate([sphere.vertices, [[5, 0, 0], [6, 0, 0]]]), sphere.faces)
    found = statistics(isolated)
    assert (found.components, found.closed, found.genus) == (1, True, 0)


def test_the_hausdorff_distance_of_parallel_sheets_and_of_a_part():
    sheet = lattice(4, 4)
    lifted = Mesh(sheet.vertices + np.array([0, 0, 0.25]), sheet.faces)
    assert hausdorff_distance(sheet, lifted) == pytest.approx(0.25)
    wider = lattice(4, 6)  # by two columns: at one corner the nearest point is the old corner
    assert hausdorff_distance(sheet, wider) == hausdorff_distance(wider, sheet)
    assert hausdorff_distance(sheet, wider) == pytest.approx(2)


def test_means_leave_out_missing_values():
    one, other = statistics(TETRAHEDRON), statistics(lattice(4, 4))
    means = dict(zip(one._fields, mean_statistics([one, other]), strict=True))
    assert means["vertices"] == 10 and means["closed"] == 0.5 and means["genus"] == 0
    assert np.isnan(means["label_distance"])


@pytest.fixture(scope="module")
def remeshed(toy_overrides):
    data = [o for o in toy_overrides if o.startswith("data")]
    words = [*data, "data/remesh=mixed", "data.remesh.vertices=120"]
    shapes = open_shapes(composed(words).data)
    shapes.prepare(shapes.names["test"])
    return shapes


def test_a_remeshed_shape_is_compared_to_its_original(remeshed):
    name = remeshed.names["test"][0]
    shape, original = remeshed.load(name), remeshed.source(name)
    found = mesh_statistics(shape, None, remeshed, name)
    assert found.as_source and 0 < found.source_distance < 1 and 0 < found.label_distance < 1
    torn = registered_shape(punctured(original.mesh, 0.05), original.mesh)
    found = mesh_statistics(torn, None, remeshed, name)
    assert not found.closed and not found.as_source


def test_registered_shapes_share_all_edges_and_remeshed_ones_few(tmp_path):
    """Two remeshed bodies share less than half of their edges, named by template vertices."""
    words = ["data=bodies_remeshed", "data.remesh.vertices=1100", f"data.cache_dir={tmp_path}"]
    shapes = open_shapes(composed([*words, "data.workers=1"]).data)
    names = shapes.names["test"][:2]
    registered = [shapes.source(name) for name in names]
    assert shared_edges(*registered) == 1
    assert len(labelled_edges(registered[0])) == len(registered[0].mesh.faces) * 3 // 2
    assert 0 < shared_edges(*map(shapes.load, names)) < 0.5


def test_damaged_shapes_are_compared_to_what_was_remeshed(remeshed):
    damage = DamageSettings(
        **dict.fromkeys(
            (
                "noise",
                "warp",
                "bumps",
                "share",
                "cut",
                "hole_radius",
                "extremities",
                "component",
                "missing",
                "size",
            ),
            0.0,
        ),
        holes=0,
        seed=0,
    )
    name = remeshed.names["test"][0]
    assert mesh_statistics(remeshed.load(name), None, Damaged(remeshed, damage), name).as_source
