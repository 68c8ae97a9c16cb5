"""Left and right put back: parts of a body whose labels are mirror images of the true ones."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.scans import scan
from meshspiral.matching.flips import mirror_images, sides_of, without_flips
from meshspiral.matching.job import FileMatch, LabelledScan
from meshspiral.matching.matcher import Matcher
from meshspiral.matching.writing import remark_lines

BODIES = Bodies(1500)
TEMPLATE = BODIES.template
TRUE = np.arange(1500)
X = TEMPLATE.vertices[:, 0]
LEFT_ARM, RIGHT_ARM = 0.16 * np.ptp(X) < X, -0.16 * np.ptp(X) > X


@pytest.fixture(scope="module")
def mirror() -> np.ndarray:
    return mirror_images(TEMPLATE, "z")


def test_mirror_images_change_sides_and_nothing_else(mirror):
    assert (LEFT_ARM[mirror] == RIGHT_ARM).mean() > 0.99
    assert (mirror[mirror] == TRUE).mean() > 0.8
    image = TEMPLATE.vertices[mirror] * [-1, 1, 1]
    apart = np.linalg.norm(image - TEMPLATE.vertices, axis=1)
    assert np.median(apart) < 0.5 * TEMPLATE.mean_edge


def test_the_sides_of_the_template(mirror):
    sides = sides_of(TEMPLATE, mirror)
    assert abs(sides[LEFT_ARM].mean()) == 1 and sides[LEFT_ARM][0] == -sides[RIGHT_ARM][0]
    middle = np.abs(X - (X.min() + X.max()) / 2) < 0.3 * TEMPLATE.mean_edge
    assert middle.sum() > 20 and (sides[middle] == 0).mean() > 0.9
    assert (sides == 0).mean() < 0.15


@pytest.mark.parametrize("pose", ["s8_walk", "s8_t_pose"])
def test_a_template_without_a_mirror_image_has_none(pose):
    """A body in T pose is thin, so that its image from front to back is near too."""
    assert mirror_images(BODIES.load(pose).mesh, "z") is None


@pytest.mark.parametrize("parts", [[LEFT_ARM], [LEFT_ARM, RIGHT_ARM]], ids=["one arm", "both arms"])
@pytest.mark.parametrize("pose", ["s9_squat", "s8_arms_up"])
def test_arms_are_put_back_and_the_rest_stays(parts, pose, mirror):
    mesh = BODIES.load(pose).mesh
    labels = TRUE.copy()
    for part in parts:
        labels[part] = mirror[TRUE[part]]
    found = without_flips(labels, mesh, TEMPLATE, mirror)
    wrong = np.linalg.norm(TEMPLATE.vertices[found] - TEMPLATE.vertices, axis=1)
    assert wrong.max() < 0.05 * TEMPLATE.size
    rest = ~np.any(parts, axis=0)
    np.testing.assert_array_equal(found[rest], TRUE[rest])


def test_a_band_around_an_arm_does_not_take_the_hand_along(mirror):
    mesh, labels = BODIES.load("s9_squat").mesh, TRUE.copy()
    band = LEFT_ARM & (np.ptp(X) * 0.3 > X)
    assert band.sum() > 30 and (LEFT_ARM & ~band).sum() > band.sum()
    labels[band] = mirror[TRUE[band]]
    found = without_flips(labels, mesh, TEMPLATE, mirror)
    np.testing.assert_array_equal(found[~band], TRUE[~band])
    assert LEFT_ARM[found[band]].mean() > 0.95


def test_noise_and_a_body_that_is_all_mirrored_stay(mirror):
    """Labels that jump to anywhere would still jump as mirror images."""
    mesh, rng = BODIES.load("s9_squat").mesh, np.random.default_rng(0)
    noisy = np.where(rng.random(1500) < 0.02, rng.integers(1500, size=1500), TRUE)
    changed = without_flips(noisy, mesh, TEMPLATE, mirror) != noisy
    assert changed.sum() <= 3
    assert not changed[noisy == TRUE].any()
    np.testing.assert_array_equal(without_flips(mirror, mesh, TEMPLATE, mirror), mirror)


def confused(matcher: Matcher, mirror: np.ndarray, part: np.ndarray, monkeypatch) -> None:
    """Let the network of a matcher see at the vertices of a part what is on the other side."""
    embed, seen = matcher._embed, np.where(part, mirror, TRUE)
    monkeypatch.setattr(matcher, "_embed", lambda mesh, *report: embed(mesh, *report)[seen])


SQUAT = BODIES.load("s9_squat").mesh
OPENED = scan(SQUAT.vertices, SQUAT.faces, "a")
LEFT_LEG = (np.mean([X.min(), X.max()]) < X) & (TEMPLATE.vertices[:, 2] < 0.4)


@pytest.mark.parametrize(
    "part, refine",
    [(LEFT_LEG, None), (LEFT_ARM, "crf"), (LEFT_LEG, "zoomout")],
    ids=["leg", "arm crf", "leg zoomout"],
)
def test_a_matcher_puts_parts_back_and_says_so(part, refine, mirror, monkeypatch):
    matcher = Matcher.load(refine=refine, ensemble=False)
    plain = matcher.label(OPENED)
    assert plain.flipped.mean() < 0.01

    confused(matcher, mirror, part, monkeypatch)
    labels, distributions = matcher.predict(OPENED)
    assert (labels.flipped == part).mean() > 0.98
    sides = sides_of(TEMPLATE, mirror)
    assert (sides[labels.template[part]] * sides[TRUE[part]] >= 0).mean() > 0.99
    match = FileMatch("a.ply", LabelledScan(OPENED, labels, distributions), None, None, None)
    [line] = [line for line in remark_lines(match) if "put back" in line]
    assert line.startswith(f"  left and right put back at {labels.flipped.sum()} vertices (")


def test_a_matcher_keeps_flips_if_asked(mirror, monkeypatch):
    matcher = Matcher.load(unflip=False)
    confused(matcher, mirror, LEFT_ARM, monkeypatch)
    kept = matcher.label(OPENED)
    assert not kept.flipped.any()
    assert LEFT_ARM[kept.template].sum() < 5
