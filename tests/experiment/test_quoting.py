"""File names of any characters on the command line reach their command as typed."""

from __future__ import annotations

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from meshspiral.commands.evaluate import main as evaluate
from meshspiral.commands.match import main as match
from meshspiral.commands.match import name_files
from meshspiral.commands.meshes import main as meshes
from meshspiral.commands.report import main as report
from meshspiral.commands.train import main as train
from meshspiral.experiment.quoting import quote, quote_words
from meshspiral.experiment.schema import EvaluateConfig, MatchConfig, ReportConfig, TrainConfig

NAMES = [
    "a[1]",
    "[a]",
    "b'c",
    'b"c',
    "'b'c'",
    "a b",
    " a",
    "a,b",
    "a=b",
    "a(1)",
    "(a)",
    "a{1}",
    "{a}",
    "a$1",
    "$a",
    "\u00e4",
    "a&b;c#d!e`f^g<h>",
    "a\\'b",
    "a\\",
    "1e3",
    "007",
    "true",
    "glob(*)",
]


def value_of(word: str) -> object:
    return OverridesParser.create().parse_override(word).value()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "key, schema",
    [("source", MatchConfig), ("runs", ReportConfig), ("run", EvaluateConfig)],
)
def test_a_text_setting_gets_the_text(key, schema, name):
    [word] = quote_words([f"{key}={name}"], schema)
    assert value_of(word) == name


@pytest.mark.parametrize("name", NAMES)
def test_a_quoted_text_is_the_text(name):
    assert value_of(f"x={quote(name)}") == name


@pytest.mark.parametrize(
    "word",
    [
        "source=a.ply",
        "source='a b.ply'",
        'source="a,b.ply"',
        "source=null",
        "model=fcs",
        "model=fcs,lstm",
        "seq_len=20",
        "+metric=true",
        "model.channels=[1,2,3]",
        "~data.remesh",
        "--help",
        "a b",
        "optim.lr=",
        "source=${oc.env:HOME}/a.ply",
    ],
)
def test_what_hydra_understands_stays(word):
    assert quote_words([word], MatchConfig) == [word]


def test_items_of_a_list_are_quoted_one_by_one():
    [word] = quote_words(["data.train=[train/a(1).ply,train/*.ply,b'c.ply]"], TrainConfig)
    assert value_of(word) == ["train/a(1).ply", "train/*.ply", "b'c.ply"]


def test_commas_separate_the_values_of_a_sweep():
    words = ["-m", "data.root=a(1),b", "resume=x,y"]
    swept = OverridesParser.create().parse_override(quote_words(words, TrainConfig)[1])
    assert list(swept.sweep_string_iterator()) == ["'a(1)'", "b"]
    assert quote_words(words, TrainConfig)[2] == words[2]


def test_an_existing_file_is_one_value(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert quote_words(["data.root=x,y"], TrainConfig) == ["data.root=x,y"]
    (tmp_path / "x,y").mkdir()
    (tmp_path / "a${b}.ply").touch()
    assert quote_words(["data.root=x,y"], TrainConfig) == ["data.root='x,y'"]
    [word] = quote_words(["source=a${b}.ply"], MatchConfig)
    assert value_of(word) == r"a\${b}.ply"  # OmegaConf reads \${ as ${


def test_home_is_expanded(monkeypatch):
    monkeypatch.setenv("HOME", "/home/ada")
    assert value_of(quote_words(["source=~/a.ply"], MatchConfig)[0]) == "/home/ada/a.ply"


def test_files_without_a_key_may_have_any_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = name_files(["b'c[1].ply", "x=y.ply"])
    assert value_of(words[0]) == "b'c[1].ply" and words[1] == "x=y.ply"
    (tmp_path / "x=y.ply").touch()
    assert name_files(["source=a.ply", "b.ply"]) == ["source=a.ply", "target='b.ply'"]
    assert name_files(["a.ply", "target=b.ply", "c.ply"])[2] == "c.ply"
    assert name_files(["a.ply", "x=y.ply"]) == ["source='a.ply'", "target='x=y.ply'"]


@pytest.mark.parametrize("name", ["a[1]", "b'c,d", "{a} (1)=$b"])
@pytest.mark.parametrize(
    "program, words",
    [
        (match, ["source={}.ply"]),
        (match, ["sources={}/*.ply"]),
        (evaluate, ["run={}"]),
        (report, ["runs={}"]),
        (train, ["resume={}"]),
        (train, ["data=folder", "data.template=t.ply", "data.root=x({}"]),
        (meshes, ["data=folder", "data.template=t.ply", "data.root=x({}"]),
    ],
    ids=["source", "sources", "run", "runs", "resume", "train-data", "meshes-data"],
)
def test_every_command_gets_a_path_as_typed(cli, program, words, name):
    code, out, err = cli(*(word.replace("{}", name) for word in words), program=program)
    expected = words[-1].partition("=")[2].replace("{}", name)
    assert code == 1 and (expected in out + err or repr(expected) in out + err)
    assert "Traceback" not in out + err and (out + err).count("error: ") == 1


def test_a_value_that_is_several_says_what_to_type(cli):
    code, out, err = cli("shapes=1,2", "runs=x", program=report)
    assert code in (1, 2)
    assert "shapes=1,2 is several values; as one value: \"shapes='1,2'\"" in out + err
    assert "as a sweep: -m shapes=1,2" in out + err


def test_an_interpolation_of_nothing_says_what_to_type(cli):
    code, out, err = cli("source=a${b}.ply", program=match)
    assert code == 1 and "where ${ is part of a name, write \\${" in out + err
