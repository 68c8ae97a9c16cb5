"""The page of a match: what it holds, and in a browser, that the mark is at the counterpart."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil

import numpy as np
import pytest
from matplotlib import pyplot as plt

from meshspiral import Matcher, scan
from meshspiral.matching import viewer
from meshspiral.matching.job import FileMatch, LabelledScan
from meshspiral.matching.writing import colors_of_values
from meshspiral.viz.colors import GREY
from tests.conftest import toy_shapes
from tests.meshes import bumpy_sphere

TOYS = toy_shapes()
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


@pytest.fixture(scope="module")
def matcher(trained):
    return Matcher.load(trained)


@pytest.fixture(scope="module")
def match(matcher) -> FileMatch:
    labelled = []
    for name in ("test/0.ply", "test/1.ply"):
        mesh = TOYS[name]
        opened = scan(mesh.vertices, mesh.faces, name)
        labelled.append(LabelledScan(opened, *matcher.predict(opened)))
    source, target = labelled
    found = matcher.match(source.scan, target.scan)
    return FileMatch("a.ply", source, target, found.target, found.confidence)


def data_of(html: str) -> list[dict]:
    text = re.search(r'id="data">(.*?)</script>', html, re.DOTALL)[1]
    return json.loads(text)["sides"]


def unpacked(text: str, dtype: type) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


def page_of(match, matcher, carried=None, script=None) -> str:
    template = matcher.template
    sides = viewer.sides_of(match, template, carried)
    return viewer.view_html(sides, match, template, matcher.up, script)


def test_the_page_holds_the_map_and_its_confidence(matcher, match):
    html = page_of(match, matcher)
    target, source = data_of(html)
    assert (target["noun"], source["noun"]) == ("target", "source")
    np.testing.assert_array_equal(unpacked(source["other"], np.int32), match.map)
    np.testing.assert_allclose(unpacked(source["confidence"], np.float32), match.confidence)
    back = unpacked(target["other"], np.int32)
    points = match.source.labels.points[back], match.target.labels.points
    apart = np.linalg.norm(points[0] - points[1], axis=1) / matcher.template.size
    np.testing.assert_allclose(unpacked(target["apart"], np.float32), apart, atol=1e-6)
    assert "http://" not in html.split("<script>")[0]


def test_two_bodies_of_10000_vertices_fit_into_8_mb(matcher, match):
    mesh = bumpy_sphere(subdivisions=5)
    rows = np.arange(len(mesh.vertices)) % 162
    labels = type(match.source.labels)(*(array[rows] for array in match.source.labels))
    large = match.source._replace(scan=scan(mesh.vertices, mesh.faces, "a.ply"), labels=labels)
    both = FileMatch("a.ply", large, large, match.map[rows], match.confidence[rows])
    colors = np.full((len(rows), 3), 0.5)
    html = page_of(both, matcher, (colors, colors))
    assert len(unpacked(data_of(html)[1]["vertex"], np.int32)) > 10000 and len(html) < 8e6


def test_a_page_without_the_script_names_it(matcher, match):
    page, alone = page_of(match, matcher, script="../plotly.min.js"), page_of(match, matcher)
    assert '<script src="../plotly.min.js"></script>' in page
    assert len(alone) > len(page) + 4e6
    assert data_of(page) == data_of(alone)


def test_the_thumbnail_shows_both_sides(matcher, match):
    image = plt.imread(io.BytesIO(viewer.thumbnail(viewer.sides_of(match, matcher.template), "y")))
    drawn = (image[..., :3] < 0.99).any(axis=(0, 2))  # columns that are not white
    edges = np.flatnonzero(np.diff(drawn.astype(int)))
    assert len(edges) >= 3  # a gap between them
    middle = image.shape[1] // 2
    for half in (image[:, :middle], image[:, middle:]):
        colors = half[(half[..., :3] < 0.99).any(axis=2)][:, :3]
        assert len(colors) > 0.2 * half.shape[0] * half.shape[1] and colors.std(axis=0).max() > 0.1


def test_without_a_target_the_template_is_beside_the_source(matcher, match):
    alone = FileMatch("a.ply", match.source, None, None, None)
    template, source = data_of(page_of(alone, matcher))
    assert template["noun"] == "template"
    np.testing.assert_array_equal(unpacked(source["other"], np.int32), match.source.labels.template)
    of_template = unpacked(template["confidence"], np.float32)
    labelled_with = unpacked(template["other"], np.int32)
    of_source = match.source.labels.near_confidence
    np.testing.assert_allclose(of_template, of_source[labelled_with])
    assert of_template.min() < of_template.max() < 1
    assert len(unpacked(template["colors"]["confidence"], np.uint8)) == 3 * len(of_template)


def test_carried_colours_can_be_shown(matcher, match):
    of_target, of_source = np.random.default_rng(0).integers(256, size=(2, 162, 3))
    carried = of_target / 255, of_source / 255
    html = page_of(match, matcher, carried)
    target, source = data_of(html)
    assert '<option value="carried">carried from the target</option>' in html
    colors = unpacked(target["colors"]["carried"], np.uint8).reshape(-1, 3)
    np.testing.assert_array_equal(colors, of_target)
    on_source = unpacked(source["colors"]["carried"], np.uint8).reshape(-1, 3)
    np.testing.assert_array_equal(on_source, of_source)


def test_values_of_any_kind_have_colours(match):
    values = np.linspace(-3, 5, 162)
    values[7] = np.nan
    for shape in ((162,), (162, 1), (162, 2), (162, 3), (162, 2, 2)):
        columns = np.broadcast_to(values.reshape(162, *[1] * (len(shape) - 1)), shape)
        target, source = colors_of_values(columns, columns[::-1], match, "x.npy")
        assert target.shape == (162, 3) and target.min() >= 0 and target.max() <= 1
        assert (target[7] == GREY).all()
        matched = match.map >= 0
        np.testing.assert_array_equal(source[matched], target[::-1][matched])
        assert len(np.unique(target.round(2), axis=0)) > 90
    truth, _ = colors_of_values(values > 0, values > 0, match, "x.npy")
    assert len(np.unique(truth, axis=0)) == 2
    colors = np.full((162, 4), 51, dtype=np.uint8)
    assert colors_of_values(colors, colors, match, "color")[0] == pytest.approx(0.2)


def test_large_meshes_are_thinned_and_the_page_says_so(matcher, match, monkeypatch):
    monkeypatch.setattr(viewer, "MOST_VERTICES", 80)
    html = page_of(match, matcher)
    target, source = data_of(html)
    shown = unpacked(source["vertex"], np.int32)
    assert len(shown) <= 85
    assert f"The source is shown with {len(shown)} of 162 vertices." in html
    others = unpacked(source["other"], np.int32)
    assert others.min() >= 0 and others.max() < len(unpacked(target["vertex"], np.int32))


def test_a_name_cannot_end_the_script(matcher, match):
    mesh = match.source.scan.mesh
    named = type(mesh)(mesh.vertices, mesh.faces, "</script><b>.ply")
    source = match.source._replace(scan=match.source.scan._replace(mesh=named))
    html = page_of(match._replace(source=source), matcher)
    assert "</script><b>" not in html


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_the_mark_follows_the_pointer(matcher, match, tmp_path):
    from playwright.sync_api import sync_playwright

    path = tmp_path / "view.html"
    path.write_text(page_of(match, matcher))
    target, source = data_of(path.read_text())
    tips = [unpacked(side["tips"], np.float32).reshape(3, -1).T for side in (target, source)]
    errors, requests = [], []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        context = browser.new_context(viewport={"width": 1000, "height": 600}, offline=True)
        page = context.new_page()
        page.on("request", lambda request: requests.append(request.url))
        page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"file://{path}")
        page.wait_for_selector("body[data-ready=yes]", timeout=120_000)
        box = page.locator("#view").bounding_box()
        seen = set()
        for side, across in enumerate((0.25, 0.75)):
            for down in (0.4, 0.6):
                page.mouse.move(box["x"] + across * box["width"], box["y"] + down * box["height"])
                page.wait_for_function(f"marks[{side}] !== null", timeout=60_000)
                page.wait_for_timeout(1000)
                marks = page.evaluate("marks")
                links = unpacked((target, source)[side]["other"], np.int32)
                assert marks[1 - side] == links[marks[side]]
                for k in range(2):
                    trace = f"document.getElementById('view').data[{2 + k}]"
                    place = page.evaluate(f"['x', 'y', 'z'].map(c => {trace}[c][0])")
                    np.testing.assert_allclose(place, tips[k][marks[k]], rtol=1e-5)
                status = page.inner_text("#status")
                assert f"vertex {marks[side]} ↔" in status and "confidence" in status
                seen.add(tuple(marks))
        assert len(seen) > 2  # it moved
        faces = "document.getElementById('view').data[1].i.length"
        before = page.evaluate(faces)
        page.locator("#least").fill("0.5")
        sure = match.confidence[match.source.scan.mesh.faces].min(axis=1) >= 0.5
        assert page.evaluate(faces) == sure.sum() < before
        camera = "document.getElementById('view').layout"
        x, y = box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"]
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 80, y + 20, steps=4)
        page.mouse.up()
        page.wait_for_timeout(1000)
        eyes = [page.evaluate(f"{camera}.{scene}.camera.eye") for scene in ("scene", "scene2")]
        assert eyes[0] == eyes[1] and eyes[0]["x"] != 0
        page.screenshot(path=tmp_path / "view.png")
        browser.close()
    assert errors == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in requests), requests
