"""The settings of all commands: their types, ranges, choices and help texts.

Default values of settings stand in conf/, and nowhere else. A network, a neighbourhood and a data
set declare their own settings, in their class's `Settings`. These classes import torch, which takes
seconds, so they are imported when a config that names them is read.
"""

from __future__ import annotations

import copy
import difflib
import importlib
import inspect
import os
import sys
import typing
from typing import Annotated, Any, Literal, Self, TypeVar

from omegaconf import DictConfig, OmegaConf
from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    SerializeAsAny,
    ValidationError,
    field_validator,
    model_validator,
)

from meshspiral.data.settings import DataSettings, Strict, Text


class ConfigError(ValueError):
    """A setting that cannot be used; the message names the key, the rule and the value."""


class MissingPluginError(ConfigError):
    """A stored config needs a plugin that was not imported; the message names it."""


C = TypeVar("C", bound=BaseModel)


Plugins = Annotated[
    list[str],
    Field(description="modules to import, which register networks, neighbourhoods or data sets"),
]
Accelerator = Annotated[Literal["cpu", "gpu"], Field(description="cpu or gpu")]
Threads = Annotated[int | None, Field(ge=1, le=1024, description="threads; null: one per core")]


class OptimSettings(Strict):
    """Adam, and the course of its learning rate."""

    epochs: int = Field(ge=1, description="number of epochs")
    lr: float = Field(gt=0, description="largest learning rate")
    betas: list[float] = Field(description="Adam's two decay rates, each in 0..1")
    schedule: Literal["cosine", "constant"] = Field(
        description="cosine: up to lr during `warmup`, then down to near 0; or constant"
    )
    warmup: float = Field(ge=0, le=1, description="share of all steps before the rate is largest")
    soft_labels: float | None = Field(
        ge=0,
        description="width of a heat kernel that blurs the labels, over the square root of the "
        "template's area; 0: where the true point lies within a face, its three vertices; null: "
        "one vertex",
    )

    @field_validator("betas")
    @classmethod
    def _two_shares(cls, betas: list[float]) -> list[float]:
        if len(betas) != 2 or not all(0 <= beta < 1 for beta in betas):
            raise ValueError("must be two numbers in 0..1, 1 excluded")
        return betas


class TrainerSettings(Strict):
    """Lightning's trainer."""

    accelerator: Literal["cpu", "gpu", "auto"] = Field(
        description="cpu, gpu, or auto: a GPU if there is one"
    )
    devices: Any = Field(description="number of devices, their list, or auto")
    strategy: Literal["auto", "ddp"] = Field(description="auto, or ddp for several devices")
    precision: Annotated[
        Literal["32", "64", "bf16", "auto"],
        BeforeValidator(lambda value: str(value) if isinstance(value, int) else value),
    ] = Field(description="32, 64, bf16, or auto: bf16 where the hardware has it, else 32")
    threads: Threads
    accumulate: int = Field(ge=1, description="meshes of a step, in each process")
    val_every: int = Field(ge=1, description="epochs from one validation to the next")


class TrainConfig(Strict):
    """Settings of `train`."""

    seq_len: int = Field(ge=1, description="number of vertices N of a spiral")
    metric: bool | None = Field(
        description="true: every element of a spiral also carries its distance and angle"
    )
    seed: int = Field(ge=0, lt=2**32, description="seed of weights, order, spirals and dropout")
    init: Text | None = Field(
        description="start from the weights of a run folder or checkpoint, or of bundled"
    )
    resume: Text | None = Field(description="folder of a run to resume or to train longer")
    plugins: Plugins
    model: SerializeAsAny[BaseModel]
    neighbourhood: SerializeAsAny[BaseModel]
    data: SerializeAsAny[DataSettings]
    trainer: TrainerSettings
    optim: OptimSettings
    picture: bool = Field(description="render test shapes after the test")

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        network = registered("model")[self.model.name]
        neighbourhoods = registered("neighbourhood")
        around = neighbourhoods[self.neighbourhood.name](self.neighbourhood)
        if network.reads != around.gives:
            fitting = [n for n, cls in neighbourhoods.items() if cls.gives == network.reads]
            raise ValueError(
                f"model {network.name} needs a neighbourhood that gives {network.reads} "
                f"({', '.join(fitting)}), got neighbourhood {around.name}"
            )
        network.check(around)
        seq_len = getattr(self.neighbourhood, "seq_len", self.seq_len)
        if seq_len != self.seq_len:
            raise ValueError(
                f"neighbourhood.seq_len must be seq_len, {self.seq_len}, got {seq_len}; set "
                f"seq_len={seq_len}"
            )
        # a run that is resumed may have other epochs than this command line, and is checked then
        if self.resume is None and self.trainer.val_every > self.optim.epochs:
            raise ValueError(
                f"trainer.val_every must be at most optim.epochs ({self.optim.epochs}), "
                f"got {self.trainer.val_every}"
            )
        return self


class EvaluateConfig(Strict):
    """Settings of `evaluate`."""

    run: Text = Field(description="folder of a run")
    data: dict[str, Any] | None = Field(
        description="another data set with the same template: data=faust_benchmark data.root=..."
    )
    rotations: int = Field(
        ge=0, description="100: that many more predictions, each with other random spirals"
    )
    votes: int = Field(ge=1, description="predict from the mean of so many draws of random spirals")
    points: bool = Field(
        description="predict points within faces of the template, too: the mean of the vertices "
        "around the label, by their probabilities"
    )
    shapes: int | list[str] = Field(description="test shapes to draw: how many, or their names")
    accelerator: Accelerator
    threads: Threads
    plugins: Plugins

    @field_validator("rotations")
    @classmethod
    def _comparable(cls, rotations: int) -> int:
        if rotations == 1:
            raise ValueError("must be 0 or at least 2")
        return rotations

    @field_validator("shapes", mode="before")
    @classmethod
    def _number_or_names(cls, shapes: Any) -> Any:
        number = isinstance(shapes, int) and not isinstance(shapes, bool) and shapes >= 0
        names = isinstance(shapes, list) and all(isinstance(name, str) for name in shapes)
        if not (number or names):
            raise ValueError("must be a number of test shapes, or a list of their names")
        return shapes


class MatchConfig(Strict):
    """Settings of `match`."""

    source: Text | None = Field(description="mesh file: PLY, OBJ, OFF, STL or GLB")
    sources: Text | None = Field(description="instead of source: a pattern of many mesh files")
    target: Text | None = Field(
        description="mesh file to match to; without it, sources are labelled with the template only"
    )
    run: Text | None = Field(description="folder of a run; null: the bundled network")
    output: Text | None = Field(description="folder to write to; null: under outputs/matches")
    repair: bool = Field(description="repair meshes that could not be used, and say how")
    resample: bool | None = Field(
        description="predict at the density of the training meshes; null: only if it is far off"
    )
    refine: Literal["zoomout", "crf"] | None = Field(
        description="refine the labels: zoomout, for complete surfaces; crf, for any; null: not"
    )
    smooth: bool = Field(description="the same as refine=zoomout")
    unflip: bool = Field(
        description="put parts back that took left for right, if the template is its own mirror "
        "image"
    )
    ensemble: bool | None = Field(
        description="average the predictions for the mesh and three resampled copies: more exact, "
        "several times the time; null: with refine=, if the network was trained on remeshed shapes"
    )
    scale: float | None = Field(
        gt=0,
        description="metres in a unit of the meshes, 0.001 for millimetres; null: radii follow "
        "from the surface area, or from the size at which the network is surest",
    )
    height: float | None = Field(
        gt=0,
        description="instead of scale: how tall the people of all meshes are when they stand, in "
        "the unit of the meshes",
    )
    transfer: Text | None = Field(
        description="carry color, uv, or a .npy array [V, ...] of the target to the source"
    )
    export: Annotated[
        list[Literal["dense", "registered", "morph"]],
        BeforeValidator(lambda v: [v] if isinstance(v, str) else v or []),
    ] = Field(
        description="also write, one or a list: dense, points in the target's faces as NumPy and "
        "CSV; registered, the source with the template's connectivity; morph, an animated GLB"
    )
    picture: bool | None = Field(
        description="render; null: with source= yes, with sources= no; false: with sources= no "
        "pages and thumbnails either"
    )
    accelerator: Accelerator
    workers: int | None = Field(ge=1, description="processes, with sources=; null: one per core")
    plugins: Plugins

    @field_validator("source", "sources", "target", "run", "output", "transfer")
    @classmethod
    def _not_empty(cls, value: str | None) -> str | None:
        if value == "":
            raise ValueError("must not be empty; leave it out, or give a path")
        return value

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.source is None) == (self.sources is None):
            raise ValueError("give source=, a mesh, or sources=, a pattern such as 'scans/*.ply'")
        needy = sorted({"dense", "morph"} & set(self.export))
        if needy and not self.target:
            raise ValueError(f"export={needy[0]} relates to the target; give target=")
        if self.smooth and self.refine not in (None, "zoomout"):
            raise ValueError(f"smooth=true is refine=zoomout; it excludes refine={self.refine}")
        if self.scale is not None and self.height is not None:
            raise ValueError(f"give scale={self.scale:g} or height={self.height:g}, not both")
        if self.transfer and not self.target:
            raise ValueError("transfer= carries values of the target to the source; give target=")
        return self


class MeshesConfig(Strict):
    """Settings of `meshes`."""

    data: SerializeAsAny[DataSettings]
    split: Literal["train", "val", "test"] | None = Field(
        description="train, val or test; null: all"
    )
    plugins: Plugins


class PreprocessConfig(Strict):
    """Settings of `preprocess`."""

    data: SerializeAsAny[DataSettings]
    neighbourhood: SerializeAsAny[BaseModel]
    seq_len: int = Field(ge=1, description="number of vertices N of a spiral")
    seed: int = Field(ge=0, lt=2**32, description="seed of the run, for data.shuffle_vertices")
    scheduler: Text | None = Field(
        description="address of a Dask scheduler whose workers compute, tcp://host:port; null: "
        "processes on this machine"
    )
    plugins: Plugins


class CacheConfig(Strict):
    """Settings of `cache`."""

    cache_dir: Text = Field(description="the folder of cached results")
    verify: bool = Field(description="read every file, and remove those that are damaged")
    unused_days: float | None = Field(
        ge=0, description="remove results that have not been read for so many days"
    )
    max_gb: float | None = Field(
        ge=0,
        description="remove the results whose last reading is longest ago, until the rest fits",
    )


class DrawConfig(Strict):
    """Settings of `draw`."""

    data: SerializeAsAny[DataSettings]
    shape: Text | None = Field(description="name of a shape; null: the first test shape")
    vertex: int = Field(ge=0, description="vertex of the template whose neighbourhoods are drawn")
    seq_len: int = Field(ge=1, description="number of vertices N of a spiral")
    neighbourhoods: dict[str, Any] = Field(
        description="settings of the neighbourhoods to draw, by any name"
    )
    output: Text = Field(description="file to write, without its ending")
    plugins: Plugins

    @field_validator("neighbourhoods", mode="before")
    @classmethod
    def _by_name(cls, groups: dict[str, Any]) -> dict[str, Any]:
        classes, known = {}, registered("neighbourhood")
        for key, values in groups.items():
            if _name(values, f"neighbourhoods.{key}") not in known:
                raise ValueError(f"{key}.name must be one of {', '.join(sorted(known))}")
            settings = known[values["name"]].Settings
            classes[key] = _validated(settings, values, f"neighbourhoods.{key}.")
        return classes


class ReportConfig(Strict):
    """Settings of `report`."""

    runs: Text = Field(description="folder that contains runs at any depth, or a pattern")
    output: Text | None = Field(description="folder to write to; null: report/ beside the runs")
    shapes: int = Field(ge=0, description="test shapes of each run to show in 3D")
    plugins: Plugins


class BenchmarkConfig(Strict):
    """Settings of `benchmark`."""

    vertices: Literal[1500, 6890] = Field(description="vertices of the mesh and of the template")
    seq_len: int = Field(ge=1, description="number of vertices N of a spiral")
    repeats: int = Field(ge=1, description="repetitions of every measurement; medians are shown")
    accelerator: Accelerator
    precision: Annotated[
        Literal["32", "bf16", "auto"],
        BeforeValidator(lambda value: str(value) if isinstance(value, int) else value),
    ] = Field(description="precision of our step: 32, bf16, or auto")
    threads: Threads
    models: list[str] = Field(description="networks to measure")
    overrides: list[str] = Field(description="settings of `train` for all of them")
    parts: list[Literal["steps", "memory", "preprocessing", "waiting", "scaling"]] = Field(
        description="what to measure"
    )
    plugins: Plugins


class DoctorConfig(Strict):
    """Settings of `doctor`."""

    cache_dir: Text = Field(description="folder of cached results")
    plugins: Plugins


# ---------------------------------------------------------------------------------- reading configs


def read_config(schema: type[C], config: DictConfig | dict[str, Any]) -> C:
    """A composed config with every value of its declared type and within its range.

    The modules that its `plugins` name are imported first.

    Raises:
        ConfigError: An unknown key, a value of another type, or one out of range.
    """
    values = _as_dict(config)
    load_plugins(values.get("plugins", []))
    return _read(schema, values)


def read_stored_config(values: dict[str, Any], source: str = "the config") -> TrainConfig:
    """The config of a run folder or checkpoint, also of an earlier version. Imports no plugins.

    Args:
        values: The stored config.
        source: Where it comes from, for messages.

    Raises:
        ConfigError: As for `read_config`.
        MissingPluginError: Only a plugin defines the network, neighbourhood or data set.
    """
    values = upgraded(_as_dict(values))
    for group in GROUPS:
        name = _name(values.get(group), group)
        if name not in registered(group) and values.get("plugins"):
            plugins = ",".join(map(str, values["plugins"]))
            raise MissingPluginError(
                f"{source} needs {group} {name} of a plugin; to import it, add plugins=[{plugins}]"
            )
    return _read(TrainConfig, values)


# settings of a spiral that were added after version 0.2, with the values of its time
STARTED = {
    "dilation": 1,
    "start": "random",
    "support": 0.3,
    "by_area": True,
    "jitter": 0,
    "pooled": 1,
}


def upgraded(values: dict[str, Any]) -> dict[str, Any]:
    """A stored config of this or an earlier version in today's layout.

    A setting that was added later gets the value that reproduces the behaviour of its time.
    """
    values = copy.deepcopy(values)
    model, data = values.get("model"), values.get("data")
    if not (isinstance(model, dict) and isinstance(data, dict)):
        return values  # reported by whoever reads it
    if "neighbourhood" not in values:  # up to version 0.1 these were settings of the model
        if patch := model.pop("patch", None):
            values["neighbourhood"] = {"name": "patch", "weights": "interpolation", **patch}
        else:
            rings = model.pop("rings", None)
            sequence = {"seq_len": values.get("seq_len"), "rings": rings}
            values["neighbourhood"] = {"name": "spiral", **sequence}
    if "metric" in model:
        model.setdefault("metric_layers", "all")
    if model.get("name") == "lstm":
        model.setdefault("recompute", False)
    if data.get("remesh"):
        data["remesh"].setdefault("copies", 1)
        data["remesh"].setdefault("shared", None)
    data.setdefault("remesh", None)
    data.setdefault("damage", None)
    if isinstance(data["damage"], dict):
        data["damage"].setdefault("warp", 0.0)
        for later in ("bumps", "extremities", "component"):
            data["damage"].setdefault(later, 0.0)
    if data.get("name") == "anny":
        data.setdefault("surface", None)
    data.setdefault("features", ["shot"])
    if isinstance(data.get("shot"), dict):
        data["shot"].setdefault("by_area", False)
    data.setdefault("raw", {"radius": 0.16, "rings": 3, "rays": 8, "support": 0.3})
    data.setdefault("hks", {"times": 16, "eigenfunctions": 128})
    bands = {"channels": 150, "eigenfunctions": 300, "largest": None}
    data.setdefault("geovec", bands)
    data.setdefault("xyz", {"rotate": False})
    if values["neighbourhood"].get("name") == "patch":
        values["neighbourhood"].setdefault("ring_width", 2.0)
    if values["neighbourhood"].get("name") == "disk" and "most" in values["neighbourhood"]:
        values["neighbourhood"]["max_vertices"] = values["neighbourhood"].pop("most")
    if values["neighbourhood"].get("name") == "spiral":
        for key, value in STARTED.items():
            values["neighbourhood"].setdefault(key, value)
    if values["neighbourhood"].get("name") == "sampled":
        values["neighbourhood"].setdefault("pooled", 1)
    data.setdefault("shuffle_vertices", False)
    data.setdefault("half", False)
    data.setdefault("fresh", False)
    data.setdefault("readers", None)
    if isinstance(values.get("optim"), dict):
        values["optim"].setdefault("soft_labels", None)
    if isinstance(values.get("trainer"), dict):
        values["trainer"].setdefault("accumulate", 1)
    values.setdefault("plugins", [])
    values.setdefault("picture", True)
    values.setdefault("init", None)
    return values


def load_plugins(names: list[str]) -> None:
    """Import modules that register networks, neighbourhoods or data sets.

    Modules are looked for in the current folder too.

    Raises:
        ConfigError: A module cannot be imported.
    """
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"plugins must be a list of modules, got {names}")
    if names and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:  # whatever the module's code raises
            reason = f"{type(error).__name__}: {error}"
            raise ConfigError(f"plugins: cannot import {name} ({reason})") from error


GROUPS = ("model", "neighbourhood", "data")


def registered(group: str) -> dict[str, Any]:
    """The classes that a config group can name: networks, neighbourhoods or data sets."""
    if group == "model":
        from meshspiral.nn.networks import Network

        return Network.registered
    if group == "neighbourhood":
        from meshspiral.neighbourhoods import Neighbourhood

        return Neighbourhood.registered
    import meshspiral.data.datasets  # noqa: F401  registers the data sets
    from meshspiral.data.shapes import ShapeSet

    return ShapeSet.registered


def _as_dict(config: DictConfig | dict[str, Any]) -> dict[str, Any]:
    if OmegaConf.is_config(config):
        return OmegaConf.to_container(config, resolve=True)
    return copy.deepcopy(config)


def _name(values: Any, group: str) -> Any:
    if not isinstance(values, dict):
        raise ConfigError(f"{group} must be a group of settings, got {values}")
    return values.get("name")


def _read(schema: type[C], values: dict[str, Any]) -> C:
    """As `read_config`, without plugins."""
    values = dict(values)
    if schema is TrainConfig:
        _spread_metric(values)
    for group in GROUPS:
        typed = schema.model_fields.get(group)
        if typed is None or _model(typed.annotation) is None:
            continue
        name, classes = _name(values.get(group), group), registered(group)
        if name not in classes:
            choices = ", ".join(sorted(classes))
            raise ConfigError(f"{group}.name must be one of {choices}, got {name}")
        settings = classes[name].Settings
        if group == "data":
            settings = _data_settings(settings, values[group])
        values[group] = _validated(settings, values[group], f"{group}.")
    return _validated(schema, values, "")


def _data_settings(settings: type[DataSettings], values: dict[str, Any]) -> type[BaseModel]:
    """The settings of a data set with those of all descriptors.

    Raises:
        ConfigError: `features` names a descriptor that is not registered.
    """
    from meshspiral.data.descriptors import Descriptor, settings_with_descriptors

    names = values.get("features")
    for name in [names] if isinstance(names, str) else names or []:
        if name not in Descriptor.registered:
            choices = ", ".join(sorted(Descriptor.registered))
            raise ConfigError(f"data.features must be one of {choices}, or a list, got {name}")
    return settings_with_descriptors(settings)


def _spread_metric(values: dict[str, Any]) -> None:
    """Give the model the root key `metric`, which wins over what an experiment file sets."""
    model = values.get("model")
    network = registered("model").get(_name(model, "model"))
    if network is None:
        return
    values["model"] = model = dict(model)
    if "metric" in network.Settings.model_fields:
        if values.get("metric") is not None:
            model["metric"] = values["metric"]
        elif model.get("metric") is None:
            model["metric"] = False
    elif values.get("metric"):
        raise ConfigError(
            f"metric=true needs a model that reads metric information, got model {network.name}"
        )


def _validated(schema: type[C], values: dict[str, Any], prefix: str) -> C:
    _check_keys(schema, values, prefix)
    try:
        return schema.model_validate(values)
    except ValidationError as error:
        raise ConfigError(_message(error.errors()[0], schema, prefix)) from error


def _check_keys(schema: type[BaseModel], values: Any, prefix: str) -> None:
    """Raise ConfigError for a key that the schema does not have, at any depth."""
    if isinstance(values, BaseModel):
        return
    if not isinstance(values, dict):
        raise ConfigError(f"{prefix.removesuffix('.')} must be a group of settings, got {values}")
    names = list(schema.model_fields)
    for key, value in values.items():
        if key not in names:
            if moved := MOVED.get(f"{prefix}{key}"):
                raise ConfigError(f"unknown key {prefix}{key}; it is {moved} now")
            close = difflib.get_close_matches(str(key), names, n=1)
            hint = f"did you mean {prefix}{close[0]}?" if close else f"known: {', '.join(names)}"
            raise ConfigError(f"unknown key {prefix}{key}; {hint}")
        annotation = schema.model_fields[key].annotation
        group = _model(annotation)
        optional = type(None) in typing.get_args(annotation)
        if group is not None and not (value is None and optional):
            _check_keys(group, value, f"{prefix}{key}.")


MOVED = {"model.rings": "neighbourhood.rings", "model.patch": "a setting of neighbourhood"}


def _model(annotation: Any) -> type[BaseModel] | None:
    """The group of settings that an annotation stands for, if it is one."""
    for kind in (annotation, *typing.get_args(annotation)):
        if inspect.isclass(kind) and issubclass(kind, BaseModel):
            return kind
    return None


RULES = {
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "list_type": "must be a list",
    "dict_type": "must be a group of settings",
    "greater_than_equal": "must be at least {ge:.10g}",
    "greater_than": "must be above {gt:.10g}",
    "less_than_equal": "must be at most {le:.10g}",
    "less_than": "must be below {lt:.10g}",
    "finite_number": "must be a finite number",
    "literal_error": "must be one of {choices}",
    "too_short": "must have at least {min_length} entry",
}


def _message(error: Any, schema: type[BaseModel], prefix: str) -> str:
    """One line for an error of pydantic: the key, the rule and the value."""
    context = dict(error.get("ctx", {}))
    if "expected" in context:
        expected = str(context["expected"]).replace(" or ", ", ").replace("'", "")
        context["choices"] = expected
    parts = [str(part) for part in error["loc"]]
    key = prefix + ".".join(part for part in parts if part.isidentifier())
    if not parts:  # of the whole config, in words of its own
        return str(context["error"])
    if error["type"] == "missing" or error["input"] is None:
        return f"{key}= is missing: {_description(schema, parts)}"
    rule = RULES.get(error["type"], error["msg"]).format(**context)
    if error["type"] == "value_error":
        rule = str(context["error"])
    return f"{key} {rule}, got {_shown(error['input'])}"


def _shown(value: Any) -> str:
    return "null" if value is None else str(value)


def _description(schema: type[BaseModel], parts: list[str]) -> str:
    """The help text of a setting."""
    for part in parts[:-1]:
        schema = _model(schema.model_fields[part].annotation) or schema
    return schema.model_fields[parts[-1]].description or "a group of settings"


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """{"a": {"b": 1}} as {"a.b": 1}."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            leaves |= flat(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves
