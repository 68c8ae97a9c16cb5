"""README.md and docs/: the site builds, links lead somewhere, and commands are those that exist."""

from __future__ import annotations

import functools
import importlib
import itertools
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import trimesh
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from markdown.extensions.toc import slugify
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from meshspiral.__main__ import COMMANDS
from meshspiral.commands.match import name_files
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.experiment.help import COMMANDS as SCHEMAS
from meshspiral.experiment.schema import ConfigError, read_config

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = {"README.md": README} | {
    str(path.relative_to(ROOT)): path.read_text() for path in sorted(ROOT.glob("docs/**/*.md"))
}
MOST_WORDS = 800
# The documented commands that are run here, in a folder with a.ply and b.obj. All others take
# minutes, or need data or a run; their configs are composed.
RUN = [
    "python -m src.train --help",
    "python -m src.match source=a.ply target=b.obj",
]
# each stands in a line of its own, for scripts that look for it
EXACT = ["pip install -e . && python -m src.train", "pip install -e '.[test]' && pytest"]
# what the API reference must contain
PUBLIC = [
    "meshspiral.data.scans.open_scan",
    "meshspiral.data.shapes.ShapeSet",
    "meshspiral.evaluation.metrics.geodesic_errors",
    "meshspiral.geometry.mesh.Mesh",
    "meshspiral.geometry.patches.geodesic_patches",
    "meshspiral.geometry.shot.shot_descriptors",
    "meshspiral.geometry.spirals.spiral_table",
    "meshspiral.matching.matcher.Matcher",
    "meshspiral.neighbourhoods.base.Neighbourhood",
    "meshspiral.nn.networks.base.Network",
    "meshspiral.nn.networks.fcs.FCSNet",
    "meshspiral.training.module.Correspondence",
]


# ------------------------------------------------------------------------------------ the commands


def code(text: str) -> Iterator[str]:
    """The lines of all shell blocks and the code spans of a page, with placeholders filled in."""
    fence = re.compile(r"^ *```(\w*)[^\n]*\n(.*?)^ *```", flags=re.S | re.M)
    for language, block in fence.findall(text):
        if language == "bash":
            yield from block.replace("\\\n", " ").splitlines()
    for span in re.findall(r"`([^`]+)`", fence.sub("", text)):
        yield " ".join(span.split())


def documented(start: str) -> list[str]:
    """All documented commands that begin with a word, without those of docs/extending.md.

    tests/test_extending.py runs the commands of that page, with the files that it adds.
    """
    found = set()
    for name, text in PAGES.items():
        if name != "docs/extending.md":
            text = re.sub(r"<[a-z][^<>|`]*>", "placeholder", text)
            for line in code(text):
                for command in re.split(r"&&|;", line):
                    if command.split()[:1] and re.match(start, command.strip()):
                        found.add(command.strip())
    return sorted(found)


def jobs(words: list[str]) -> list[list[str]]:
    """The first and the last job of a sweep, which have the first and the last of all values."""
    overrides = OverridesParser.create().parse_overrides(words)
    if not any(override.is_sweep_override() for override in overrides):
        return [words]
    picks = []
    for last in (0, -1):
        picks.append([])
        for word, override in zip(words, overrides, strict=True):
            if override.is_sweep_override():
                value = list(override.sweep_string_iterator())[last]
                word = f"{override.get_key_element()}={value}"
            picks[-1].append(word)
    return picks


@functools.cache
def composed(command: str, *words: str) -> DictConfig:
    """The config of a command with the node `hydra`, from its key=value words."""
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
            return compose(command, list(words), return_hydra_config=True)
    finally:
        GlobalHydra.instance().hydra = before


def check_job(command: str, words: list[str]) -> None:
    """Compose the config of a command, and check it; of an experiment with a sweep also its jobs.

    Hydra composes each choice of groups once. Values are set afterwards, to save time.

    Raises:
        ConfigError, HydraException, OmegaConfBaseException: It cannot be composed or used.
    """
    overrides = OverridesParser.create().parse_overrides(words)
    keys = [override.key_or_group for override in overrides]
    groups = [key.startswith("hydra") or (ROOT / "conf" / key).is_dir() for key in keys]
    config = composed(command, *itertools.compress(words, groups)).copy()
    swept = config.hydra.sweeper.params or {}
    values = [f"{key}={value}" for key, value in swept.items() if key not in keys]
    config = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
    OmegaConf.set_struct(config, True)  # an unknown key is an error
    for override, group in zip(overrides, groups, strict=True):
        if not group:
            OmegaConf.update(config, override.key_or_group, override.value())
    read_config(SCHEMAS[command], config)
    rest = [word for word, key in zip(words, keys, strict=True) if key != "experiment"]
    for job in jobs(values) if values else []:
        check_job(command, rest + job)


def check(line: str) -> None:
    """Check that a command line names an existing command, with settings that it has.

    Raises:
        AssertionError: There is no such command.
        ConfigError, HydraException, OmegaConfBaseException: A word cannot be parsed, is unknown, or
            has no valid value.
    """
    words = shlex.split(line, comments=True)
    if words[0] == "meshspiral":
        command, words = words[1], words[2:]
    else:
        command, words = words[2].removeprefix("src."), words[3:]
        assert (ROOT / "src" / f"{command}.py").is_file(), f"no command src.{command}"
    assert command in COMMANDS, f"no command {command}"
    words = [word for word in words if not word.startswith("-") and word not in ("job", "all")]
    words = name_files(words) if command == "match" else words
    for job in jobs(words):
        if job or command in ("train", "benchmark", "meshes"):  # the others need a word
            check_job(command, job)


ERRORS = (AssertionError, ConfigError, HydraException, OmegaConfBaseException)
OURS = r"(time )?python -m src\.|meshspiral [a-z]"


def test_there_are_commands_to_check():
    commands = documented(OURS)
    assert len(commands) > 80
    assert {command.split()[2] for command in commands if "-m src" in command} >= {
        f"src.{name}" for name in COMMANDS
    }


def test_every_documented_command_composes():
    wrong = []
    for line in documented(OURS):
        try:
            check(line.removeprefix("time "))
        except ERRORS as error:
            wrong.append(f"{line}: {error}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "line",
    [
        "python -m src.trian seq_len=20",
        "python -m src.train model=mlp",
        "python -m src.train model.rings=2",
        "python -m src.train seq_len=0",
        "python -m src.train -m seq_len=15,many",
        "python -m src.match source=a.ply aim=b.ply",
        "meshspiral trian",
    ],
)
def test_a_wrong_command_is_found(line):
    with pytest.raises(ERRORS):
        check(line)


def test_documented_tests_exist():
    """The files, and for every -k at least one test."""
    commands = [shlex.split(command) for command in documented("pytest")]
    assert sum("-k" in words for words in commands) >= 4
    for words in commands:
        files = [ROOT / word for word in words[1:] if word.endswith(".py")]
        names = [
            name
            for file in files or (ROOT / "tests").rglob("test_*.py")
            for name in re.findall(r"^def (test_\w+)", file.read_text(), flags=re.M)
        ]
        wanted = words[words.index("-k") + 1].split(" or ") if "-k" in words else ["test"]
        for part in wanted:
            assert any(part in name for name in names), f"{words}: no test is named {part}"
    for command in documented(r"(taskset -c 0 )?python -m tests\."):
        module = re.search(r"tests\.(\w+)", command)[1]
        assert (ROOT / "tests" / f"{module}.py").is_file(), command


def test_documented_extras_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {
        extra
        for text in PAGES.values()
        for names in re.findall(r"-e '\.\[([\w,]+)\]'", text)
        for extra in names.split(",")
    }
    assert extras >= {"test", "docs", "remesh", "parallel", "cluster"}
    assert extras <= set(project["optional-dependencies"])


@pytest.fixture
def two_meshes(tmp_path) -> Path:
    """A folder with a.ply and b.obj, two bodies."""
    bodies = Bodies(1500)
    for name, body in {"a.ply": "s8_t_pose", "b.obj": "s9_squat"}.items():
        mesh = bodies.load(body).mesh
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / name)
    return tmp_path


@pytest.mark.parametrize("command", RUN)
def test_a_documented_command_runs(command, cli, two_meshes):
    assert command in documented("python")
    name, *words = shlex.split(command.removeprefix("python -m src."))
    main = importlib.import_module(f"meshspiral.commands.{name}").main
    code, out, err = cli(*words, program=main)
    assert code == 0, out + err
    if name == "match":
        assert (two_meshes / "outputs" / "matches" / "a_to_b" / "map.txt").is_file()


def test_the_lines_of_python_run(two_meshes, monkeypatch):
    [lines] = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    for page in ("docs/matching.md", "docs/api/index.md"):
        assert lines.splitlines()[:3] == PAGES[page].split("```python\n")[1].splitlines()[:3]
    monkeypatch.chdir(two_meshes)
    scope: dict = {}
    exec(lines, scope)
    assert scope["match"].target.shape == (1500,) and scope["match"].target.dtype == "int32"


# -------------------------------------------------------------------------------------- the README


def test_the_readme_is_short():
    assert len(README.split()) <= MOST_WORDS
    assert README.count("![") == 1


@pytest.mark.parametrize("line", EXACT)
def test_a_line_stands_word_for_word(line):
    assert line in README.splitlines()


def test_what_the_readme_links_to_is_there():
    links = re.findall(r"\]\((?!http)([^)]+)\)", README)
    assert len(links) > 20
    for link in links:
        path, _, anchor = link.partition("#")
        assert (ROOT / path).is_file(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)", (ROOT / path).read_text(), flags=re.M)
            assert anchor in [slugify(heading, "-") for heading in headings], link


def test_no_page_is_unfinished():
    for name, text in PAGES.items():
        assert not re.search(r"\b(TODO|FIXME|XXX|TBD)\b", text), name


# ---------------------------------------------------------------------------------------- the site


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built strictly: a broken link or a missing reference is an error."""
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_page_is_in_the_site(site):
    for name in PAGES.keys() - {"README.md"}:
        page = Path(name).relative_to("docs").with_suffix("")
        path = page.parent if page.name == "index" else page
        assert (site / path / "index.html").is_file(), name


def test_pages_load_nothing_from_the_network(site):
    for path in [*site.rglob("*.html"), *site.rglob("*.css")]:
        text = path.read_text()
        loaded = re.findall(r"<(?:script|img|iframe)[^>]*src=[\"']?(?:https?:)?//[^\s>]*", text)
        loaded += re.findall(r"<link[^>]*href=[\"']?(?:https?:)?//[^\s>]*", text)
        loaded += re.findall(r"(?:@import|url\()\s*[\"']?(?:https?:)?//[^\s)]*", text)
        assert not loaded, f"{path.relative_to(site)}: {loaded[0]}"


def test_the_reference_has_the_public_names(site):
    text = "".join(path.read_text() for path in site.glob("api/**/*.html"))
    assert [name for name in PUBLIC if f'id="{name}"' not in text] == []
