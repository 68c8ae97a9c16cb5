"""Colours, curves and renders."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from meshspiral.evaluation.metrics import THRESHOLDS
from meshspiral.geometry.mesh import Mesh
from meshspiral.viz.colors import (
    GREY,
    MOST_ERROR,
    confidence_colors,
    error_colors,
    point_colors,
    template_colors,
)
from meshspiral.viz.plots import (
    all_curves_figure,
    curve_figure,
    encoded,
    neighbourhood_figure,
)
from meshspiral.viz.render import Row, render, upright
from meshspiral.viz.sketch import sketch
from tests.meshes import bumpy_sphere, lattice


def test_equal_points_have_equal_colours_and_unknown_ones_are_grey():
    template = bumpy_sphere()
    low, high = template.vertices.min(axis=0), template.vertices.max(axis=0)
    points = np.array([low, high, (low + high) / 2, [np.nan] * 3, high + 1])
    expected = np.array([0.1, 1.0, 0.55, GREY, 1.0])
    np.testing.assert_allclose(point_colors(template, points), np.tile(expected[:, None], 3))
    np.testing.assert_array_equal(
        template_colors(template), point_colors(template, template.vertices)
    )


def test_error_colours_darken_and_end_at_a_fifth():
    grey = error_colors(np.linspace(0, 0.3, 31)) @ [0.299, 0.587, 0.114]
    assert (np.diff(grey[:21]) < 0).all() and (np.diff(grey[20:]) == 0).all()


def test_full_confidence_looks_like_no_error():
    np.testing.assert_array_equal(confidence_colors([1.0, 0.0]), error_colors([0.0, MOST_ERROR]))


def test_no_two_curves_look_alike_and_no_name_covers_one():
    curves = {f"run {i}": (THRESHOLDS, np.full(len(THRESHOLDS), i / 24)) for i in range(24)}
    figure = curve_figure(curves)
    [axes] = figure.axes
    assert len({(line.get_color(), line.get_linestyle()) for line in axes.lines}) == 24
    FigureCanvasAgg(figure).draw()
    [legend] = figure.legends
    names = legend.get_window_extent()
    assert len(legend.get_texts()) == 24
    assert names.x0 >= axes.get_window_extent().x1 and names.y0 >= 0


def test_long_names_stand_below_the_axes_and_leave_them_wide():
    name = (
        "DiffusionNet, bodies mixed, shot.by_area yes, epochs 22, lr 0.002, val_every 2, and more"
    )
    curves = {f"{name} {i}": (THRESHOLDS, THRESHOLDS) for i in range(4)}
    figure = curve_figure(curves)
    FigureCanvasAgg(figure).draw()
    [axes], [legend] = figure.axes, figure.legends
    box, names, page = axes.get_window_extent(), legend.get_window_extent(), figure.bbox
    assert names.y1 <= box.y0 and names.y0 >= 0
    assert names.x0 >= 0 and names.x1 <= page.x1
    assert box.width > 0.7 * page.width and box.height > 300
    assert len(legend.get_texts()) == 4


def test_curves_of_several_runs_have_a_band():
    curves = np.stack([THRESHOLDS, THRESHOLDS / 2])
    [axes] = curve_figure({"a": (THRESHOLDS, curves), "b": (THRESHOLDS, THRESHOLDS)}).axes
    assert len(axes.collections) == 1 and len(axes.lines) == 2
    np.testing.assert_allclose(axes.lines[0].get_ydata(), 75 * THRESHOLDS)
    figure = all_curves_figure(THRESHOLDS, curves)
    assert len(figure.axes[0].lines) == 2
    assert encoded(figure, "svg") == encoded(figure, "svg")


@pytest.mark.parametrize(
    "up, view, turned",
    [
        ("y", "front", [1, 2, 3]),
        ("y", "back", [-1, 2, -3]),
        ("z", "front", [1, 3, -2]),
        ("z", "back", [-1, 3, 2]),
    ],
)
def test_views_are_rotations_with_the_up_axis_up(up, view, turned):
    assert upright(np.array([[1.0, 2.0, 3.0]]), up, view).tolist() == [turned]
    assert np.linalg.det(upright(np.eye(3), up, view)) == 1


def test_a_flat_mesh_is_drawn():
    mesh = lattice(4, 4)
    rows = []
    for axis in range(3):
        flat = Mesh(np.insert(mesh.vertices[:, :2], axis, 0.0, axis=1), mesh.faces)
        rows.append(Row([flat], [np.ones((16, 3))]))
        assert sketch(flat.vertices, flat.faces, rows[-1].colors[0]).shape[0] == 320
    for picture in render(rows, "y"):
        assert picture.images[0].shape[1] < 25 * picture.images[0].shape[0]


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_a_sketch_shows_the_inside_through_a_hole_darker():
    colors = np.ones((4, 3)) * [1.0, 0.6, 0.2]
    for faces, shade in ((FACES, 1.0), (FACES[:, ::-1], 0.5)):
        image = sketch(SQUARE, faces, colors, 100)
        assert image.shape == (100, 100, 3) and (image[0] == 255).all()
        np.testing.assert_allclose(image[50, 50], 255 * shade * colors[0], atol=1)


def test_a_sketch_shows_what_is_in_front():
    points = np.concatenate([SQUARE, SQUARE * [2, 1, 1] - [0, 0, 1]])
    faces, colors = np.concatenate([FACES, FACES + 4]), np.repeat([[1.0, 0, 0], [0, 0, 1.0]], 4, 0)
    image = sketch(points, faces, colors, 100)
    assert image.shape == (100, 200, 3)
    assert image[50, 50].tolist() == [255, 0, 0] and image[50, 150].tolist() == [0, 0, 255]
    assert sketch(points * [50, 1, 1], faces, colors, 100).shape == (100, 500, 3)


def test_neighbourhoods_of_one_point_are_seen_from_one_side():
    """Although the normal at it differs between two tessellations."""
    mesh = bumpy_sphere(2)
    turn = [[1, 0, 0], [0, np.cos(0.1), -np.sin(0.1)], [0, np.sin(0.1), np.cos(0.1)]]
    other = Mesh(mesh.vertices @ np.transpose(turn), mesh.faces)
    points = mesh.vertices[:9]
    panels = [("one", mesh, 5, points), ("other", other, 5, points)]
    one, other = (a.lines[0].get_xydata() for a in neighbourhood_figure(panels, up="z").axes)
    np.testing.assert_allclose(one - one[0], other - other[0], atol=1e-12)
