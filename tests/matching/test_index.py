"""The index of many matches: worst first, with thumbnails and reasons of refusal."""

from __future__ import annotations

import re

import numpy as np

from meshspiral.matching.index import read_entry, write_index
from meshspiral.matching.writing import THUMBNAIL


def match(folder, confidence, template=None, files=()):
    folder.mkdir(parents=True)
    confidence = np.array(confidence, dtype=np.float32)
    template = np.zeros(len(confidence), int) if template is None else np.array(template)
    np.savez(folder / "match.npz", near_confidence=confidence, template=template)
    for name in files:
        (folder / name).write_text("")


def test_the_worst_match_comes_first_and_unfinished_ones_not_at_all(tmp_path):
    match(tmp_path / "good", [0.9, 0.8, 0.9])
    match(tmp_path / "bad", [0.1, 0.2, 0.9])
    (tmp_path / "unfinished").mkdir()
    write_index(tmp_path, ["good", "bad", "unfinished"], ["c.ply: no usable face <here>"])
    html = (tmp_path / "index.html").read_text()
    assert re.findall(r'href="(.*?)"', html) == ["bad/remarks.txt", "good/remarks.txt"]
    assert "2 matches in" in html and "below 0.5 at 66.7 %" in html
    assert "c.ply: no usable face &lt;here&gt;" in html and "<code>picture=false" in html


def test_a_match_with_pictures_has_a_thumbnail_that_leads_to_its_page(tmp_path):
    match(tmp_path / "a b#", [0.9], files=("view.html", THUMBNAIL))
    write_index(tmp_path, ["a b#"], [])
    html = (tmp_path / "index.html").read_text()
    assert '<a href="a%20b%23/view.html"><img src="a%20b%23/match_thumbnail.png"' in html
    assert "picture=false" not in html
    write_index(tmp_path, [], ["c.ply: no usable face"])
    assert "picture=false" not in (tmp_path / "index.html").read_text()


def test_vertices_without_a_label_do_not_count(tmp_path):
    match(tmp_path / "a", [0.0, 0.8], template=[-1, 3])
    entry = read_entry(tmp_path, "a")
    assert (entry.unsure, round(entry.median, 3)) == (0.0, 0.8)
    match(tmp_path / "none", [0.0], template=[-1])
    assert read_entry(tmp_path, "none").unsure == 1.0


def test_the_confidence_of_the_map_decides_where_there_is_one(tmp_path):
    for name, near, whole in (("a", 0.9, 0.1), ("b", 0.2, 0.8)):
        match(tmp_path / name, [near])
        template, near = np.zeros(1, int), np.float32([near])
        confidences = {"near_confidence": near, "map_confidence": np.float32([whole])}
        np.savez(tmp_path / name / "match.npz", template=template, **confidences)
    write_index(tmp_path, ["a", "b"], [])
    html = (tmp_path / "index.html").read_text()
    assert re.findall(r'href="(.*?)"', html) == ["a/remarks.txt", "b/remarks.txt"]
