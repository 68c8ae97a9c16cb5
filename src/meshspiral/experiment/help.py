"""The text of --help, from the settings' descriptions and the files in conf/."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from omegaconf import OmegaConf
from pydantic import BaseModel

from meshspiral.data.descriptors import Descriptor
from meshspiral.data.settings import DamageSettings, DataSettings, RemeshSettings
from meshspiral.experiment.program import command_line
from meshspiral.experiment.schema import (
    GROUPS,
    BenchmarkConfig,
    CacheConfig,
    DoctorConfig,
    DrawConfig,
    EvaluateConfig,
    MatchConfig,
    MeshesConfig,
    OptimSettings,
    PreprocessConfig,
    ReportConfig,
    TrainConfig,
    TrainerSettings,
    registered,
)

COMMANDS = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "match": MatchConfig,
    "meshes": MeshesConfig,
    "preprocess": PreprocessConfig,
    "cache": CacheConfig,
    "draw": DrawConfig,
    "report": ReportConfig,
    "benchmark": BenchmarkConfig,
    "doctor": DoctorConfig,
}
HIDDEN_GROUPS = ("cli", "hydra")


def settings_help(command: str, conf: Path) -> str:
    """What --help prints for a command.

    Args:
        command: Name of the command and of its file in conf/.
        conf: The folder conf/.
    """
    intro = [
        line.removeprefix("#").strip()
        for line in (conf / f"{command}.yaml").read_text().splitlines()
        if line.startswith("#")
    ]
    about = [line for line in intro if not line.startswith("python -m")]
    examples = [
        "  " + line.replace(f"python -m src.{command}", command_line(command))
        for line in intro
        if line.startswith("python -m")
    ]
    lines = [*about, "", "Examples:", *examples]
    if groups := _groups(command, conf):
        lines += ["", "Groups (choose with group=option):", *groups]
    lines += ["", "Settings (change with key=value):", *_settings(COMMANDS[command])]
    if command == "train":
        parts: dict[str, type[BaseModel]] = {
            "optim.": OptimSettings,
            "trainer.": TrainerSettings,
            "data.": DataSettings,
            **{f"data.{name}.": each.Settings for name, each in Descriptor.registered.items()},
            "data.remesh.": RemeshSettings,
            "data.damage.": DamageSettings,
        }
        for prefix, schema in parts.items():
            lines += _settings(schema, prefix)
        for group in GROUPS:
            lines += ["", f"Settings of {group}, with the options that have them:"]
            lines += _settings_of_options(group)
    lines += ["", "All settings with their values: add --cfg job", ""]
    return "\n".join(lines).replace("$", "$$")  # Hydra substitutes $NAME


def _groups(command: str, conf: Path) -> list[str]:
    defaults = OmegaConf.to_container(OmegaConf.load(conf / f"{command}.yaml"))["defaults"]
    used = {key for entry in defaults if isinstance(entry, dict) for key in entry}
    used |= {"neighbourhood"} if "model" in used else set()
    used |= {"data/remesh", "data/damage"} if "data" in used else set()
    lines = []
    for group in sorted(used - set(HIDDEN_GROUPS)):
        options = sorted(path.stem for path in (conf / group).glob("*.yaml"))
        lines.append(f"  {group:<14} {', '.join(options)}")
    return lines


def _settings(schema: type[BaseModel], prefix: str = "", skip: Iterable[str] = ()) -> list[str]:
    """A line for each setting that is not a group of settings."""
    return [
        f"  {prefix + name:<24} {field.description}"
        for name, field in schema.model_fields.items()
        if field.description and name not in skip
    ]


def _settings_of_options(group: str) -> list[str]:
    """The settings of all options of a group, each with the options that have it unless all do."""
    classes = registered(group)
    options: dict[str, list[str]] = {}
    for name, cls in classes.items():
        shared = DataSettings.model_fields if group == "data" else ()
        for line in _settings(cls.Settings, f"{group}.", shared):
            options.setdefault(line, []).append(name)
    return [
        line if len(names) == len(classes) else f"{line} ({', '.join(names)})"
        for line, names in options.items()
    ]
