"""The neighbourhood of MoNet: disks over their radius, angles from the frame's x axis."""

from __future__ import annotations

import numpy as np

from meshspiral.data.preprocessing import compute_task, frame_task
from meshspiral.geometry.disks import geodesic_disks
from meshspiral.geometry.sampling import surface_directions
from meshspiral.geometry.shot import Frame
from meshspiral.neighbourhoods.disk import Disk
from tests.meshes import bumpy_sphere


def test_disks_are_over_their_radius_and_turned_to_the_frame():
    mesh = bumpy_sphere()
    disk = Disk(Disk.Settings(name="disk", radius=0.3, max_vertices=30, support=0.5))
    assert disk.frame == Frame(0.5, by_area=True)
    frames = compute_task(frame_task(mesh, disk.frame))["frames"]
    arrays = disk.compute(mesh, frames)
    turn = surface_directions(mesh, frames[:, 0])
    assert np.isfinite(turn).all()
    expected = geodesic_disks(mesh, 0.3 * mesh.size, 30, turn)
    np.testing.assert_array_equal(arrays["indices"], expected.indices)
    np.testing.assert_array_equal(arrays["angles"], expected.angles)
    np.testing.assert_allclose(arrays["distances"] * 0.3 * mesh.size, expected.distances, rtol=1e-6)
    assert 0.5 < arrays["distances"].max() <= 1
