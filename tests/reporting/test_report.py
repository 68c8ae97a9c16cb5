"""Reports: groups of runs, compared curves, tables, the page, and omitted runs."""

from __future__ import annotations

import base64
import csv
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshspiral.commands.report import main
from meshspiral.data.settings import DamageSettings
from meshspiral.experiment.run_folder import CONFIG, METRICS
from meshspiral.nn.networks import FCSNet, Network
from meshspiral.reporting.groups import data_labels, group_runs, length_keys, varied_settings
from meshspiral.reporting.page import page_html
from meshspiral.reporting.plots import compared_curves, file_name
from meshspiral.reporting.runs import Run, common_folder, read_runs
from meshspiral.reporting.scenes import Scenes
from meshspiral.reporting.tables import run_table
from tests.conftest import toy_shapes
from tests.helpers import QUICK, run

SWEEP = {
    "fcs5": ["seq_len=5"],
    "fcs5_again": ["seq_len=5", "seed=1"],
    "fcs6": ["seq_len=6"],
    "fcs5_metric": ["seq_len=5", "metric=true"],
    "lstm5": ["model=lstm", "seq_len=5"],
    "fcs6_metric": ["seq_len=6", "metric=true"],
    "gcnn3": ["model=gcnn3", "neighbourhood.radius=0.2", "optim.lr=0.002"],
}


REMESH = ["data.remesh={policy: mixed, vertices: 120, copies: 1, shared: null}"]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory, toy_overrides):
    folder = tmp_path_factory.mktemp("sweep")
    for name, overrides in SWEEP.items():
        run(folder / name, [*toy_overrides, "optim.epochs=1", *overrides])
    return folder


class Page(HTMLParser):
    """A parsed page: the cells of its tables, the attributes of all tags, and the data."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.attributes, self.data, self._in = [], [], "", None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.attributes.append((tag, dict(attributes)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        self._in = dict(attributes).get("id") if tag == "script" else tag

    def handle_endtag(self, tag):
        self._in = None

    def handle_data(self, data):
        if self._in in ("td", "th", "button"):
            self.rows[-1][-1] += data.strip()
        if self._in == "data":
            self.data += data


def test_rare_columns_wait_for_a_checkbox(sweep):
    """So that the table fits 1300 pixels; the checkbox works without scripts."""
    optims = [
        {"lr": 0.1 + i, "warmup": 0.1 * i, "epochs": 7 + i, "betas": [0.1 * i, 0]} for i in range(4)
    ]
    runs = read_runs(str(sweep))[0]
    runs = [changed(run, optim=optim) for run, optim in zip(runs, optims, strict=False)]
    groups = group_runs([*runs, changed(runs[0], seed=5)])
    text = page_html(groups, [], {}, Scenes(), [])
    columns, _ = run_table(groups)
    shown = [*columns[:5], "optim.betas", "optim.epochs", "optim.lr", *columns[9:12]]
    for table, seeds in zip(text.split("<table")[1:], ("seed", "seeds"), strict=True):
        heads = re.findall(r'<th(?: class="(\w+)")?>(?:<button>)?([^<]*)', table)
        visible = [name for kind, name in heads if kind != "rare"]
        assert visible == [seeds if name == "seed" else name for name in shown]
        for row in table.split("<tbody>")[1].split("</tr>")[:-1]:
            hidden = ['class="rare"' in cell for cell in row.split("<td")[1:]]
            assert hidden == [kind == "rare" for kind, _ in heads]
    checkbox = text.index('<input type="checkbox" id="all">')
    assert checkbox < text.index("<table") and "#all:not(:checked) ~ .wide .rare" in text
    folder = str(runs[0].folder)
    assert f'<tr title="{folder}">' in text  # which run a row shows


def changed(run: Run, **groups: dict) -> Run:
    """The run with other settings: changed(run, optim={"lr": 1.0}, seed=2)."""
    values = {}
    for key, value in groups.items():
        group = getattr(run.config, key)
        values[key] = group.model_copy(update=value) if isinstance(value, dict) else value
    return replace(run, config=run.config.model_copy(update=values))


def test_runs_that_differ_in_the_seed_alone_are_one_group(sweep):
    runs, omitted = read_runs(str(sweep))
    assert len(runs) == 7 and omitted == []
    groups = group_runs(runs)
    assert sorted(len(group.runs) for group in groups) == [1, 1, 1, 1, 1, 2]
    [pair] = [group for group in groups if len(group.runs) == 2]
    assert {r.folder.name for r in pair.runs} == {"fcs5", "fcs5_again"}
    assert pair.curves.shape[0] == 2
    assert varied_settings(runs) == ["optim.lr"]


def test_data_labels_can_be_read(sweep):
    """Settings of training shapes alone tell groups apart, but not the data sets."""
    run = read_runs(str(sweep))[0][0]
    damage = DamageSettings(**dict.fromkeys(DamageSettings.model_fields, 0) | {"noise": 0.002})
    runs = [run, *(changed(run, data=data) for data in ({"fresh": True}, {"damage": damage}))]
    assert data_labels(runs) == ["folder"] * 3
    assert varied_settings(runs) == ["data.damage", "data.fresh"]
    assert len(group_runs(runs)) == 3
    other = changed(run, data={"labels": "{stem}.npy"})
    assert data_labels([run, other]) == ["folder identity", "folder {stem}.npy"]


def test_the_comparisons_of_the_paper_are_found(sweep):
    groups = group_runs(read_runs(str(sweep))[0])
    found = {title: list(curves) for title, curves in compared_curves(groups)}
    networks = found["Networks at N = 5 without metric information, folder"]
    assert sorted(networks) == ["FCS-NET, lr 0.004", "GCNN3, lr 0.002", "LSTM-NET, lr 0.004"]
    lengths = [v for k, v in found.items() if k.startswith("Lengths of FCS-NET")]
    assert lengths == 2 * [["N = 5", "N = 6"]]  # with and without metric information
    [metric] = [v for k, v in found.items() if k.startswith("Metric information: FCS-NET, N = 5")]
    assert sorted(metric) == ["with metric information", "without"]
    assert not any("LSTM" in title for title in found)


def test_a_report_has_a_page_tables_and_plots(cli, sweep, tmp_path):
    code, out, err = cli(f"runs={sweep}", "output=report", "shapes=2", program=main)
    assert code == 0, err
    assert "Runs:    7, 0 omitted" in out
    folder = tmp_path / "report"
    text = (folder / "index.html").read_text()
    page = Page(text)
    links = [v for _, a in page.attributes for k, v in a.items() if k in ("src", "href")]
    # the page loads nothing from the internet
    assert [link for link in links if not link.startswith(("data:", "#"))] == []
    columns, _ = run_table(group_runs(read_runs(str(sweep))[0]))
    assert page.rows[0] == columns and len(page.rows) == 1 + 7 + 1 + 1  # one group has two seeds
    assert "±" in " ".join(page.rows[-1])
    with open(folder / "table.csv") as file:
        table = list(csv.reader(file))
    assert table[0] == columns and len(table) == 8
    rows = {row[-1]: row for row in table[1:]}
    for name in SWEEP:
        metrics = json.loads((sweep / name / METRICS).read_text())
        row = dict(zip(columns, rows[str(sweep / name)], strict=True))
        assert float(row["exact match (%)"]) == pytest.approx(100 * metrics["test/exact_match"])
        assert int(float(row["parameters"])) == metrics["parameters"]
    assert len(list(folder.glob("*.pdf"))) == text.count("<figcaption>") == 9
    assert len(list(folder.glob("*.png"))) == 9
    tex = (folder / "table.tex").read_text()
    body = [line for line in tex.splitlines() if line.endswith(r"\\")]
    assert len(body) == 7 and len({line.count("&") for line in body}) == 1
    assert r"$\pm$" in tex and "_" not in tex.replace(r"\_", "")
    markdown = (folder / "table.md").read_text().splitlines()
    assert len(markdown) == 2 + 6 and len({line.count("|") for line in markdown}) == 1
    [pair] = [line for line in markdown if "±" in line]
    assert pair.startswith("| FCS-NET | 5 | no | folder | 2 | 0.004 |")


def test_the_shapes_of_the_page_are_those_of_the_data_set(cli, sweep, tmp_path):
    cli(f"runs={sweep}", "output=report", "shapes=2", program=main)
    data = json.loads(Page((tmp_path / "report/index.html").read_text()).data)
    scenes, surfaces = data["scenes"], data["surfaces"]
    assert len(scenes) == 14 and len(surfaces) == 3  # the template and two shapes, once each
    template = toy_shapes()["template.ply"]
    scene = scenes[0]
    points = (
        np.frombuffer(base64.b64decode(surfaces[scene["template"]]["points"]), "<f4")
        .reshape(3, -1)
        .T
    )
    middle = (template.vertices.min(axis=0) + template.vertices.max(axis=0)) / 2
    np.testing.assert_allclose(points, template.vertices - middle, atol=1e-5)
    faces = (
        np.frombuffer(base64.b64decode(surfaces[scene["shape"]]["faces"]), "<i4").reshape(3, -1).T
    )
    np.testing.assert_array_equal(faces, template.faces)
    labels = np.frombuffer(base64.b64decode(scene["labels"]), "<i4")
    assert labels.tolist() == list(range(162))


def test_remeshed_shapes_have_their_own_surfaces(cli, toy_overrides, tmp_path):
    run(tmp_path / "run", [*toy_overrides, *REMESH, "optim.epochs=1"])
    code, out, err = cli("runs=run", "shapes=2", program=main)
    assert code == 0 and "cannot show" not in out, err
    [row] = csv.reader((tmp_path / "run/report/table.csv").read_text().splitlines()[1:])
    assert row[0] == "FCS-NET" and row[3] == "folder mixed"
    data = json.loads(Page((tmp_path / "run/report/index.html").read_text()).data)
    sizes = {scene["name"]: len(base64.b64decode(scene["labels"])) // 4 for scene in data["scenes"]}
    assert len(sizes) == 2 and 162 not in sizes.values()
    for scene in data["scenes"]:
        points = base64.b64decode(data["surfaces"][scene["shape"]]["points"])
        assert len(points) == 3 * 4 * sizes[scene["name"]]


def test_unreadable_runs_are_listed_and_the_others_shown(cli, sweep, tmp_path):
    copy = Path(shutil.copytree(sweep, tmp_path / "copy"))
    (copy / "fcs6" / METRICS).write_text('{"test/exact_match": 0.')
    (copy / "lstm5" / METRICS).unlink()
    (copy / "gcnn3" / CONFIG).write_text("[not, a, config]")
    (copy / "fcs5_metric" / CONFIG).write_text("of: another program")
    code, out, err = cli("runs=copy", "shapes=0", program=main)
    assert code == 0, err
    assert "Runs:    3, 4 omitted" in out
    text = (copy / "report" / "index.html").read_text()
    reasons = {
        "fcs6": "metrics.json is damaged",
        "lstm5": "not finished",
        "gcnn3": "is not the config of a run",
        "fcs5_metric": "is not the config of a run",
    }
    for name, reason in reasons.items():
        assert re.search(rf"copy/{name}\b.*{reason}", text)
        assert re.search(rf"omitted: copy/{name}\b.*{reason}", out)
    code, out, _ = cli("runs=copy", "shapes=0", program=main)  # the report's folder is not a run
    assert code == 0 and "Runs:    3, 4 omitted" in out


def test_without_the_data_set_only_the_shapes_are_missing(cli, toy, toy_overrides, tmp_path):
    root = Path(shutil.copytree(toy, tmp_path / "here"))
    overrides = [o.replace(str(toy), str(root)) for o in toy_overrides]
    run(tmp_path / "run", [*overrides, "optim.epochs=1"])
    shutil.rmtree(root)
    code, out, err = cli("runs=run", program=main)
    assert code == 0, err
    page = (tmp_path / "run/report/index.html").read_text()
    assert "run: cannot show its shapes (" in out
    assert "run: cannot show its shapes (" in page
    assert json.loads(Page(page).data)["scenes"] == []


def test_shapes_of_a_data_set_that_changed_are_not_shown(cli, toy, toy_overrides, tmp_path):
    root = Path(shutil.copytree(toy, tmp_path / "here"))
    run(tmp_path / "run", [*(o.replace(str(toy), str(root)) for o in toy_overrides), *QUICK])
    for path in root.rglob("*.ply"):
        mesh = trimesh.load(path, process=False).subdivide()
        mesh.export(path)
    code, out, err = cli("runs=run", program=main)
    assert code == 0, err
    assert "has changed since the test: other vertices or labels" in out
    page = (tmp_path / "run/report/index.html").read_text()
    assert json.loads(Page(page).data)["scenes"] == []


def test_only_seeds_are_pooled(sweep):
    """Other test shapes or another precision make another group; equal seeds count once."""
    [one] = read_runs(str(sweep / "fcs5"))[0]
    other = replace(one, outcome=replace(one.outcome, labels=one.outcome.labels[::-1]))
    double = changed(one, trainer={"precision": "64"})
    groups = group_runs([one, other, double, one])
    assert sorted(len(group.runs) for group in groups) == [1, 1, 2]
    assert all(group.seeds == {0} for group in groups)
    assert {group.label() for group in groups} == {
        "FCS-NET, N = 5, folder, precision 32",
        "FCS-NET, N = 5, folder (2), precision 32",
        "FCS-NET, N = 5, folder, precision 64",
    }


def test_settings_that_change_no_result_are_pooled(sweep):
    [one] = read_runs(str(sweep / "fcs5"))[0]
    other = changed(
        one,
        seed=1,
        plugins=["my_package.spheres"],
        picture=True,
        resume="outputs/run",
        trainer={"accelerator": "gpu", "threads": 7},
        data={"cache_dir": "elsewhere", "workers": 7, "root": "elsewhere"},
    )
    [group] = group_runs([one, other])
    assert group.seeds == {0, 1}


def test_seeds_that_shuffle_vertices_are_pooled(sweep):
    [one] = read_runs(str(sweep / "fcs5"))[0]
    shuffled = [
        replace(
            changed(one, seed=seed, data={"shuffle_vertices": True}),
            outcome=replace(one.outcome, labels=np.roll(one.outcome.labels, seed)),
        )
        for seed in (0, 1)
    ]
    [group] = group_runs(shuffled)
    assert group.seeds == {0, 1}


def test_settings_of_a_neighbourhood_appear_under_its_name(sweep):
    """`rings` is a length for spirals, and an ordinary setting for patches."""
    runs = {run.folder.name: run for run in read_runs(str(sweep))[0]}
    spirals = [changed(runs["lstm5"], neighbourhood={"rings": rings}) for rings in (None, 1, 2)]
    patches = [changed(runs["gcnn3"], neighbourhood={"rings": rings}) for rings in (3, 4)]
    several = [*spirals, *patches]
    assert length_keys(several) == {"spiral.rings"}
    assert length_keys(list(runs.values())) == {"spiral.seq_len"}
    assert varied_settings(several) == ["optim.lr", "patch.rings"]
    assert [group.label("optim.lr") for group in group_runs(several)] == [
        "GCNN3, folder, patch.rings 3",
        "GCNN3, folder, patch.rings 4",
        "LSTM-NET, 1 rings, folder",
        "LSTM-NET, 2 rings, folder",
        "LSTM-NET, N = 5, folder",
    ]


def test_a_network_without_sequences_ignores_the_root_seq_len(sweep):
    [one] = read_runs(str(sweep / "gcnn3"))[0]
    [group] = group_runs([one, changed(one, seq_len=30, seed=1)])
    assert group.length is None and group.metric is None and group.label() == "GCNN3, folder"


def test_networks_with_the_same_title_get_different_names(sweep, monkeypatch):
    monkeypatch.setattr(Network, "registered", {**Network.registered, "wide": FCSNet})
    [one] = read_runs(str(sweep / "fcs5"))[0]
    groups = group_runs([one, changed(one, model={"name": "wide"})])
    assert [group.network for group in groups] == ["FCS-NET (fcs)", "FCS-NET (wide)"]


def test_data_sets_with_the_same_name_are_distinguished_by_their_settings(sweep):
    [one] = read_runs(str(sweep / "fcs5"))[0]
    other = changed(one, data={"labels": "{stem}.txt"})
    described = changed(one, data={"shot": one.config.data.shot.model_copy(update={"bins": 5})})
    assert data_labels([one, other]) == ["folder identity", "folder {stem}.txt"]
    assert data_labels([one, described]) == ["folder", "folder"]
    assert varied_settings([one, described]) == ["data.shot.bins"]


def test_a_name_cannot_break_the_page(cli, sweep, tmp_path):
    name = "<!--<script> [q] & it's 5 %"
    shutil.copytree(sweep / "fcs5", tmp_path / "odd" / name)
    shutil.copytree(sweep / "fcs6", tmp_path / "odd" / "b")
    code, _, err = cli("runs=odd", program=main)
    assert code == 0, err
    text = (tmp_path / "odd/report/index.html").read_text()
    script = text[text.index('id="data"') :]
    assert "<" not in script[script.index(">") + 1 : script.index("</script>")]
    page = Page(text)
    assert name in {scene["run"] for scene in json.loads(page.data)["scenes"]}
    assert f"odd/{name}" in {row[-1] for row in page.rows if row}
    assert read_runs(str(tmp_path / "odd" / name))[0]  # wildcards in a folder's name


def test_file_names_of_plots_are_short_and_unique():
    assert file_name("Lengths of FCS-NET++, a") != file_name("Lengths of FCS-NET, a")
    long = "x" * 300
    assert len(file_name(long)) < 120 and file_name(long) != file_name(long + "y")


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "runs= is missing: folder that contains runs at any depth, or a pattern"),
        (["runs=nowhere"], "runs=nowhere: there is no such folder"),
        (["runs=."], "runs=. contains no finished run"),
        (["runs=.", "shapes=-1"], "shapes must be at least 0, got -1"),
    ],
)
def test_a_mistake_gives_a_one_line_error(cli, arguments, message):
    code, out, err = cli(*arguments, program=main)
    assert code == 1
    assert message in (out + err).strip().splitlines()[-1]


def test_a_report_is_written_beside_its_runs():
    assert common_folder("outputs/sweeps/a") == Path("outputs/sweeps/a")
    assert common_folder("outputs/*/b") == Path("outputs")
    assert common_folder("*") == Path()
