"""The command line: documented commands, help, sweeps, and one-line errors."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys

import pytest
import torch
from omegaconf import OmegaConf
from torch.utils.data import DataLoader, Dataset

from meshspiral.data.settings import RemeshSettings, ShotSettings
from meshspiral.experiment.entry import one_line
from meshspiral.experiment.help import COMMANDS
from meshspiral.experiment.run_folder import write_metrics
from meshspiral.experiment.schema import (
    GROUPS,
    ConfigError,
    OptimSettings,
    TrainerSettings,
    registered,
)
from meshspiral.experiment.sweeps import invocation, job_folder
from meshspiral.geometry.mesh import MeshError
from tests.helpers import QUICK, ROOT, clone_environment, composed


def test_the_documented_command_works(cli, toy_overrides, tmp_path):
    toy = [o for o in toy_overrides if not o.startswith("seq_len")]
    code, out, err = cli("model=fcs", "seq_len=20", "+metric=true", *toy, *QUICK)
    assert code == 0, err
    assert "spirals of 20 vertices with metric information" in out
    for line in (
        "exact match",
        "within 0.05 sqrt(area)",
        "mean geodesic error / sqrt(area)",
        "mean geodesic error / diameter",
        "Run folder:",
        "tensorboard --logdir",
    ):
        assert line in out
    [folder] = (tmp_path / "outputs").glob("*/*_fcs")
    assert (folder / "metrics.json").is_file() and (folder / "train.log").is_file()
    assert OmegaConf.load(folder / "config.yaml").model.metric is True
    assert "Warning" not in err


def test_the_documented_sweep_works(cli, toy_overrides, tmp_path, monkeypatch):
    """Checks its jobs; `train` is replaced."""
    metrics = {"test/exact_match": 0.0, "test/geodesic_error": 0.0}
    monkeypatch.setattr(
        "meshspiral.training.run.train", lambda config, folder: write_metrics(folder, metrics)
    )
    toy = [o for o in toy_overrides if not o.startswith(("seq_len", "data.cache_dir"))]
    sweep = ["-m", "model=lstm,fcs", "seq_len=5,6", "+metric=true,false"]
    code, _, err = cli(*sweep, *toy, *QUICK, "hydra.sweep.dir=sweep")
    assert code == 0, err
    runs = [path.parent for path in (tmp_path / "sweep").glob("*/metrics.json")]
    assert len(runs) == 8
    settings = set()
    for folder in runs:
        config = OmegaConf.load(folder / "config.yaml")
        settings.add((config.model.name, config.seq_len, config.model.metric))
        prefix = f"model-{config.model.name}_seq_len-{config.seq_len}_metric-"
        assert folder.name == prefix + str(config.model.metric).lower()
    assert len(settings) == 8


def test_one_sweep_trains_all_three_networks(cli, toy_overrides, tmp_path):
    code, _, err = cli("-m", "model=lstm,fcs,gcnn3", *toy_overrides, *QUICK, "hydra.sweep.dir=s")
    assert code == 0, err
    metrics = {
        path.parent.name: json.loads(path.read_text())
        for path in (tmp_path / "s").glob("*/metrics.json")
    }
    assert sorted(metrics) == ["model-fcs", "model-gcnn3", "model-lstm"]
    names = {tuple(sorted(values)) for values in metrics.values()}
    assert len(names) == 1  # all have the same metrics


@pytest.mark.parametrize(
    "override, expected",
    [
        ("+metric=true", True),
        ("metric=true", True),
        ("++metric=false", False),
        ("metric=null", False),
        ("model.metric=true", True),
        (None, False),
    ],
)
def test_every_way_to_set_metric(override, expected):
    assert composed([override] if override else []).model.metric is expected


def test_the_root_setting_metric_overrides_model_metric():
    assert composed(["model.metric=true", "+metric=false"]).model.metric is False
    assert composed(["model.metric=false", "+metric=true"]).model.metric is True


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["+metric=maybe"], "metric must be true or false, got maybe"),
        (["seq_len=0"], "seq_len must be at least 1, got 0"),
        (["seq_len=many"], "seq_len must be a whole number, got many"),
        (
            ["model=foo"],
            "Could not find 'model/foo'; there are: acnn, conv, diffusion, fcs, gcnn3, lstm, monet",
        ),
        (["data=foo"], "there are: anny, bodies, bodies_6890, bodies_6890_remeshed, bodies_mixed,"),
        (["+metrics=true"], "unknown key metrics; did you mean metric?"),
        (["+rate=1"], "unknown key rate; known: seq_len"),
        (["metrics=true"], "unknown setting metrics; did you mean metric?"),
        (
            ["model=gcnn3", "model.metric=true"],
            "model.metric is a setting of other options of model than the chosen one",
        ),
        (["modell=lstm"], "unknown setting modell; did you mean model?"),
        (["optim.lrr=1"], "unknown setting optim.lrr; did you mean optim.lr?"),
        (["xyz=1"], "unknown setting xyz; python -m src.train --help lists them"),
        (["--seed", "3"], "--seed is not an option; settings have no dashes: seed=3"),
        (["--seq_len=9"], "--seq_len=9 is not an option; settings have no dashes: seq_len=9"),
        (["trainer.threads=100000"], "trainer.threads must be at most 1024, got 100000"),
        (["model.dropout=1.5"], "model.dropout must be below 1, got 1.5"),
        (["model.metric_layers=some"], "model.metric_layers must be one of all, first, got some"),
        (["+model.depth=3"], "unknown key model.depth"),
        (["model.rings=2"], "model.rings is neighbourhood.rings now"),
        (["+model.rings=2"], "unknown key model.rings; it is neighbourhood.rings now"),
        (["model=gcnn3", "model.patch.radius=1"], "model.patch is a setting of neighbourhood now"),
        (["neighbourhood.rings=1"], "fcs needs sequences of one length, got spirals of 1 rings"),
        (
            ["neighbourhood=patch"],
            "needs a neighbourhood that gives spirals (sampled, spiral), got neighbourhood patch",
        ),
        (["model.channels=[1,2,0]"], "model.channels must be three numbers of at least 1"),
        (["model.channels=[1,2,x]"], "model.channels must be a whole number, got x"),
        (
            ["neighbourhood=foo"],
            "'neighbourhood/foo'; there are: anisotropic, disk, operators, patch, sampled, spiral",
        ),
        (["plugins=[no_such.module]"], "plugins: cannot import no_such.module (ModuleNotFound"),
        (["plugins=5"], "plugins must be a list of modules, got 5"),
        (["optim.lr=-1"], "optim.lr must be above 0, got -1"),
        (
            ["model=gcnn3", "+metric=true"],
            "metric=true needs a model that reads metric information, got model gcnn3",
        ),
        (["model=gcnn3", "neighbourhood.rays=15"], "neighbourhood.rays must be even, got 15"),
        (["model=gcnn3", "neighbourhood.radius=0"], "neighbourhood.radius must be above 0, got 0"),
        (["model=gcnn3", "neighbourhood.weights=flat"], "must be one of interpolation, gaussian"),
        (["neighbourhood=null"], "neighbourhood=null: a config group must be one of its options"),
        (["model=gcnn"], "Could not find 'model/gcnn'; did you mean gcnn3?"),
        (
            ["neighbourhood.seq_len=5"],
            "neighbourhood.seq_len must be seq_len, 20, got 5; set seq_len=5",
        ),
        (["model=gcnn3", "+neighbourhood.sectors=8"], "unknown key neighbourhood.sectors"),
        (["optim.betas=[2,3]"], "optim.betas must be two numbers in 0..1"),
        (["optim.betas=[0.9]"], "optim.betas must be two numbers in 0..1"),
        (["optim=5"], "optim must be a group of settings, got 5"),
        (["data.shot=5"], "data.shot must be a group of settings, got 5"),
        (["data=folder", "data.train=5"], "data.train must be file names or patterns, got 5"),
        (
            ["optim.epochs=1", "trainer.val_every=2"],
            "trainer.val_every must be at most optim.epochs (1), got 2",
        ),
        (["optim.epochs=0"], "optim.epochs must be at least 1, got 0"),
        (["data.shot.radius=0"], "data.shot.radius must be above 0"),
        (
            ["data.shuffle_vertices=perhaps"],
            "data.shuffle_vertices must be true or false, got perhaps",
        ),
        (["trainer.precision=8"], "trainer.precision must be one of 32, 64, bf16, auto, got 8"),
        (
            ["model.channels=[1,2]"],
            "model.channels must be three numbers of at least 1, got [1, 2]",
        ),
        (["data=faust"], "data.root"),
        (
            ["data=folder", "data.root=/none", "data.template=t.ply"],
            "data.root must be a folder, got /none",
        ),
        (["data.vertices=12"], "1500"),
        (["seed=99999999999"], "seed must be below 4294967296, got 99999999999"),
        (["resume=nowhere"], "resume=nowhere: is not a folder"),
        (["trainer.accelerator=tpu"], "trainer.accelerator must be one of cpu, gpu, auto, got tpu"),
        (["trainer.strategy=fsdp"], "trainer.strategy must be one of auto, ddp, got fsdp"),
        (["optim.warmup=5"], "optim.warmup must be at most 1, got 5"),
        (["model=conv", "model.taps=2"], "model.taps must be odd, got 2"),
        (["optim.lr=", "x y"], "x y"),
        (["hydra.run.dir=/dev/null/run"], "/dev/null"),
        (["data.cache_dir=/dev/null/cache"], "cannot write the cache /dev/null/cache"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_gives_a_one_line_error(cli, arguments, message):
    code, out, err = cli(*arguments)
    assert code in (1, 2)
    last = (out + err).strip().splitlines()[-1]
    assert last.startswith("error: ") and message in last, out + err
    assert (out + err).count("error: ") == 1 and "Traceback" not in out + err


@pytest.mark.parametrize(
    "override",
    ["trainer.devices=none"] + ["trainer=gpu"] * (not torch.cuda.is_available()),
)
def test_an_unavailable_device_gives_a_one_line_error(cli, toy_overrides, override):
    code, out, err = cli(*toy_overrides, override)
    last = (out + err).strip().splitlines()[-1]
    assert code == 1 and last.startswith("error: trainer: accelerator")
    assert "Traceback" not in out + err


def test_help_shows_groups_settings_and_three_examples(cli):
    code, out, _ = cli("--help")
    assert code == 0
    lines = [" ".join(line.split()) for line in out.splitlines()]
    for line in (
        "model acnn, conv, diffusion, fcs, gcnn3, lstm, monet",
        "neighbourhood anisotropic, disk, operators, patch, sampled, spiral",
        "trainer cpu, ddp, gpu",
        "data/remesh isotropic, mixed, scans",
        "seq_len number of vertices N of a spiral",
        "optim.lr largest learning rate",
        "data.shot.bins bins of the cosine; 16 give 544 channels",
        "data.raw.rings number of rings of the polar grid",
        "model.metric read metric information: distance and angle (conv, fcs, lstm)",
        "neighbourhood.rays number of rays of the polar grid, even (patch)",
        "data.vertices vertices of the template and the bodies (bodies)",
    ):
        assert line in lines
    assert len([line for line in lines if line.startswith("python -m")]) >= 3


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_names_its_settings_and_no_internal_group(cli, command):
    code, out, _ = cli(
        "--help", program=importlib.import_module(f"meshspiral.commands.{command}").main
    )
    assert code == 0 and f"python -m src.{command}" in out
    lines = [line.split() for line in out.splitlines() if line.strip()]
    settings = {words[0] for words in lines}
    declared = COMMANDS[command].model_fields
    assert {name for name, field in declared.items() if field.description} <= settings
    assert "cli" not in settings


def test_the_command_line_is_read_without_torch():
    """Help and most mistakes take a second, not five."""
    script = "import sys, meshspiral.commands.match; sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], env=clone_environment(), check=False)
    assert done.returncode == 0


def test_every_setting_has_a_help_text():
    schemas = [*COMMANDS.values(), OptimSettings, TrainerSettings, ShotSettings, RemeshSettings]
    schemas += [cls.Settings for group in GROUPS for cls in registered(group).values()]
    for schema in schemas:
        for name, field in schema.model_fields.items():
            group = name in ("name", "model", "neighbourhood", "data", "shot", "trainer", "optim")
            assert field.description or group, f"{schema.__qualname__}.{name}"


def test_the_documented_commands_compose():
    """Every example of --help, and every command in a comment of conf/."""
    commands = []
    for path in (ROOT / "conf").rglob("*.yaml"):
        text = path.read_text().replace("\\\n#", "")
        for line in text.splitlines():
            if "python -m src.train" in line:
                words = line.split("python -m src.train")[1].replace("'", "").split()
                commands.append([w for w in words if "=" in w])
    assert len(commands) > 8
    for words in commands:
        single = [w if "[" in w else w.split(",")[0] for w in words]
        if not any(word.startswith("resume") for word in words):
            composed(single)


def test_a_failed_job_logs_its_error_and_the_others_run(cli, toy_overrides, tmp_path):
    code, out, err = cli("-m", "optim.lr=0,0.01", *toy_overrides, *QUICK, "hydra.sweep.dir=sweep")
    assert code == 1
    failed, done = (tmp_path / "sweep" / f"optim.lr-{lr}" for lr in ("0", "0.01"))
    assert "error: optim.lr must be above 0, got 0" in (failed / "train.log").read_text()
    assert (done / "metrics.json").is_file() and not (failed / "metrics.json").exists()
    assert "Traceback" not in out + err


def test_an_error_in_a_reader_is_one_line():
    class Broken(Dataset):
        def __len__(self):
            return 1

        def __getitem__(self, i):
            raise MeshError(f"mesh {i}: no faces")

    with pytest.raises(MeshError, match="Traceback") as raised:
        next(iter(DataLoader(Broken(), batch_size=None, num_workers=1)))
    assert one_line(raised.value) == "mesh 0: no faces"


def test_jobs_never_share_a_folder():
    """Also where characters are replaced or names are shortened."""
    values = ["[train/*.ply]", "[train/?.ply]", "/a/b", "a/b", "x" * 300, "x" * 301, "1", "2"]
    with invocation(["-m", "seq_len=8", "data.root=1,2"]):
        names = [job_folder(["seq_len=8", f"data.root={value}"], 0) for value in values]
    assert len(set(names)) == len(values)
    assert names[-2:] == ["data.root-1", "data.root-2"]
    assert all(re.fullmatch(r"[\w.+-]{1,130}", name) for name in names)
    assert job_folder(["seq_len=8"], 3) == "seq_len-8"  # a sweep of one
    assert job_folder([], 3) == "3"


def test_a_folder_with_another_run_is_not_overwritten(cli, toy_overrides, tmp_path):
    folder = [*toy_overrides, "hydra.run.dir=run"]
    assert cli(*folder, *QUICK)[0] == 0
    before = (tmp_path / "run" / "config.yaml").read_text()
    code, out, err = cli(*folder, *QUICK, "seed=7")
    assert code == 1 and "run holds another run, whose seed differ" in out + err
    assert (tmp_path / "run" / "config.yaml").read_text() == before
    assert cli(*folder, *QUICK)[0] == 0  # the same run: already finished


def test_config_errors_name_the_key():
    with pytest.raises(ConfigError, match=r"trainer\.threads must be at least 1, got 0"):
        composed(["trainer.threads=0"])
