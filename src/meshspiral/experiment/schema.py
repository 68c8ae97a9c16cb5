"""What a user may set, with types; and what is said of a mistake."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, field, fields
from typing import Any

from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException


class ConfigError(ValueError):
    """A setting that can't be; the message names the key, the rule and the value."""


@dataclass
class Model:
    name: str = MISSING
    channels: list[int] = MISSING
    dropout: float = 0.3
    feature_scale: float = 1.0


@dataclass
class FCS(Model):
    metric: bool = False
    metric_layers: str = "all"


@dataclass
class LSTM(FCS):
    rings: int | None = None


@dataclass
class Patch:
    radius: float = MISSING
    rings: int = 5
    rays: int = 16
    weights: str = "interpolation"


@dataclass
class GCNN3(Model):
    patch: Patch = field(default_factory=Patch)


@dataclass
class Shot:
    radius: float = MISSING
    bins: int = 16


@dataclass
class Remesh:
    policy: str = "isotropic"
    vertices: int | None = None
    copies: int = 1


@dataclass
class Data:
    name: str = MISSING
    remesh: Remesh | None = None
    shot: Shot = field(default_factory=Shot)
    shuffle_vertices: bool = False
    cache_dir: str = MISSING
    workers: int | None = None


@dataclass
class Bodies(Data):
    vertices: int = 1500


@dataclass
class Faust(Data):
    root: str | None = None


@dataclass
class FaustBenchmark(Data):
    root: str | None = None
    benchmark_root: str | None = None
    policy: str = "iso"
    train: list[str] | None = None


@dataclass
class Folder(Data):
    root: str | None = None
    template: str | None = None
    train: Any = field(default_factory=list)
    val: Any = field(default_factory=list)
    test: Any = field(default_factory=list)
    labels: str | None = "{stem}.txt"


@dataclass
class Optim:
    epochs: int = MISSING
    lr: float = MISSING
    betas: list[float] = field(default_factory=lambda: [0.9, 0.999])
    schedule: str = MISSING
    warmup: float = 0.1


@dataclass
class Trainer:
    accelerator: str = "cpu"
    devices: Any = 1
    strategy: str = "auto"
    precision: str = "32"
    threads: int | None = None
    val_every: int = 1


@dataclass
class Train:
    seq_len: int = MISSING
    metric: bool | None = None
    seed: int = 0
    resume: str | None = None
    model: Any = MISSING
    data: Any = MISSING
    trainer: Trainer = field(default_factory=Trainer)
    optim: Optim = field(default_factory=Optim)
    picture: bool = True


MODELS = {"fcs": FCS, "lstm": LSTM, "gcnn3": GCNN3}
DATASETS = {"bodies": Bodies, "faust": Faust, "faust_benchmark": FaustBenchmark, "folder": Folder}

AT_LEAST = {
    "seq_len": 1,
    "seed": 0,
    "optim.epochs": 1,
    "optim.warmup": 0,
    "data.workers": 1,
    "data.shot.bins": 1,
    "data.remesh.vertices": 12,
    "data.remesh.copies": 1,
    "model.rings": 1,
    "model.patch.rings": 1,
    "trainer.threads": 1,
    "trainer.val_every": 1,
}
ABOVE_ZERO = ("optim.lr", "data.shot.radius", "model.feature_scale", "model.patch.radius")
ONE_OF = {
    "optim.schedule": ("cosine", "constant"),
    "model.metric_layers": ("all", "first"),
    "model.patch.weights": ("interpolation", "gaussian"),
    "data.remesh.policy": ("isotropic", "adaptive", "refined", "simplified", "marching", "mixed"),
    "trainer.precision": ("32", "64", "bf16", "auto"),
}


def checked(config: DictConfig) -> DictConfig:
    """The composed config with every value of its declared type, within its range.

    Errors: ConfigError for an unknown key, a value of another type, or one out of range.
    """
    schema = OmegaConf.structured(Train)
    plain = OmegaConf.to_container(config, resolve=True)
    for group, schemas in (("model", MODELS), ("data", DATASETS)):
        schema[group] = _one_of(plain[group], group, schemas)
    _known(plain, Train, "")
    _known(plain["trainer"], Trainer, "trainer.")
    _known(plain["optim"], Optim, "optim.")
    _known(plain["data"]["shot"], Shot, "data.shot.")
    if "patch" in schema.model:
        _known(plain["model"]["patch"], Patch, "model.patch.")
    if "metric" in schema.model:
        if plain.get("metric") is not None:
            plain["model"]["metric"] = plain["metric"]  # the root key wins over an experiment's
        elif plain["model"].get("metric") is None:
            plain["model"]["metric"] = False
    elif plain.get("metric"):
        raise ConfigError(
            "metric=true needs a model with spirals, whose elements carry it; "
            f"got model {plain['model']['name']}"
        )
    _fill(schema, plain)
    _check_ranges(schema)
    return schema


def checked_data(config: DictConfig) -> DictConfig:
    """A data config alone, in the same way."""
    plain = OmegaConf.to_container(config, resolve=True)
    schema = _one_of(plain, "data", DATASETS)
    _fill(schema, plain)
    _check_values(OmegaConf.create({"data": schema}))
    return schema


def _one_of(plain: Any, group: str, schemas: dict[str, type]) -> DictConfig:
    """The schema that a group's name chooses."""
    _is_group(plain, group)
    if plain.get("name") not in schemas:
        raise ConfigError(
            f"{group}.name must be one of {', '.join(schemas)}; got {plain.get('name')}"
        )
    _known(plain, schemas[plain["name"]], f"{group}.")
    schema = OmegaConf.structured(schemas[plain["name"]])
    if plain.get("remesh") is not None:
        _known(plain["remesh"], Remesh, "data.remesh.")
        schema.remesh = OmegaConf.structured(Remesh)
    return schema


def typed(config: DictConfig, schema: type) -> DictConfig:
    """A flat config with every value of its declared type. Errors: ConfigError as above."""
    plain = OmegaConf.to_container(config, resolve=True)
    _known(plain, schema, "")
    filled = OmegaConf.structured(schema)
    _fill(filled, plain)
    return filled


def _fill(schema: DictConfig, plain: dict[str, Any]) -> None:
    for key, value in flat(plain).items():
        try:
            OmegaConf.update(schema, key, value)
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(f"{key}={value}: {reason}") from error


def _check_values(typed: DictConfig) -> None:
    """Those that need no others to be judged by."""
    for key, least in AT_LEAST.items():
        value = OmegaConf.select(typed, key)
        if value is not None and value < least:
            raise ConfigError(f"{key} must be at least {least}; got {value}")
    for key in ABOVE_ZERO:
        value = OmegaConf.select(typed, key)
        if value is not None and not 0 < value < math.inf:
            raise ConfigError(f"{key} must be above 0; got {value}")
    for key, values in ONE_OF.items():
        if (value := OmegaConf.select(typed, key)) not in (None, *values):
            raise ConfigError(f"{key} must be one of {', '.join(values)}; got {value}")


def _check_ranges(typed: DictConfig) -> None:
    if missing := sorted(OmegaConf.missing_keys(typed)):
        raise ConfigError(f"{missing[0]} must be given")
    _check_values(typed)
    if typed.trainer.val_every > typed.optim.epochs:
        raise ConfigError(
            f"trainer.val_every must be at most optim.epochs, {typed.optim.epochs}: without a "
            f"validation there is no best checkpoint; got {typed.trainer.val_every}"
        )
    if len(typed.optim.betas) != 2 or not all(0 <= beta < 1 for beta in typed.optim.betas):
        raise ConfigError(
            f"optim.betas must be two numbers in 0..1, 1 left out; got {typed.optim.betas}"
        )
    if typed.data.name == "folder":
        for split in ("train", "val", "test"):
            names = typed.data[split]
            listed = [names] if isinstance(names, str) else names
            is_list = isinstance(listed, list | ListConfig)
            if not is_list or not all(isinstance(name, str) for name in listed):
                raise ConfigError(f"data.{split} must be file names or patterns; got {names}")
    if typed.seed >= 2**32:
        raise ConfigError(f"seed must be below {2**32}; got {typed.seed}")
    if len(typed.model.channels) != 3 or min(typed.model.channels) < 1:
        raise ConfigError(
            f"model.channels must hold three numbers of at least 1; got {typed.model.channels}"
        )
    if "patch" in typed.model and (typed.model.patch.rays < 2 or typed.model.patch.rays % 2):
        raise ConfigError(
            f"model.patch.rays must be even and at least 2; got {typed.model.patch.rays}"
        )
    if not 0 <= typed.model.dropout < 1:
        raise ConfigError(f"model.dropout must be in 0..1, 1 left out; got {typed.model.dropout}")


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """{"a": {"b": 1}} as {"a.b": 1}."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            leaves |= flat(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves


def _is_group(given: Any, name: str) -> None:
    if not isinstance(given, dict):
        raise ConfigError(f"{name} is a group of settings; got {given}")


def _known(given: Any, schema: type, prefix: str) -> None:
    _is_group(given, prefix.removesuffix("."))
    names = [f.name for f in fields(schema)]
    for key in given:
        if key not in names:
            close = difflib.get_close_matches(key, names, n=1)
            hint = f"did you mean {prefix}{close[0]}?" if close else f"known: {', '.join(names)}"
            raise ConfigError(f"unknown key {prefix}{key}; {hint}")
