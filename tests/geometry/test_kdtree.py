"""Nearest points, also of points of which most have a coordinate of 0."""

import subprocess
import sys

import numpy as np

from meshspiral.geometry.kdtree import kd_tree

CODE = """
import sys
import numpy as np, torch
from meshspiral.geometry.kdtree import kd_tree
torch.set_flush_denormal(True)
points = np.array([[0.0] * 30 + [1.0] * 10]).T
print(kd_tree(points).query([[0.9]])[0])
"""


def test_the_nearest_point_is_that_of_all_distances():
    rng = np.random.default_rng(0)
    points, others = rng.normal(size=(200, 3)), rng.normal(size=(50, 3))
    distance, nearest = kd_tree(points).query(others)
    apart = np.linalg.norm(others[:, None] - points, axis=2)
    np.testing.assert_array_equal(nearest, apart.argmin(axis=1))
    np.testing.assert_allclose(distance, apart.min(axis=1))


def test_points_at_zero_where_denormal_numbers_count_as_zero():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("[0.1"), done.stderr
