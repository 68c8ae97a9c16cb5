"""The data sets by name, as a config names them."""

from __future__ import annotations

from typing import Any

from meshspiral.data.cache import Store
from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.datasets.faust import Faust
from meshspiral.data.datasets.faust_benchmark import FaustBenchmark
from meshspiral.data.datasets.folder import Folder
from meshspiral.data.preprocessing import PatchRecipe, Recipe
from meshspiral.data.remeshed import Remeshed
from meshspiral.data.shapes import ShapeSet

SOURCES = {"bodies": Bodies, "faust": Faust, "faust_benchmark": FaustBenchmark, "folder": Folder}
# not the source's affair
COMMON = ("name", "remesh", "shot", "shuffle_vertices", "cache_dir", "workers")


def open_shapes(data: dict[str, Any]) -> ShapeSet:
    """The data set that a data config describes. Errors: DataError, MeshError."""
    options = {key: value for key, value in data.items() if key not in COMMON}
    shapes = SOURCES[data["name"]](**options)
    if data.get("remesh"):
        return Remeshed(shapes, Store(data["cache_dir"]), data["workers"], **data["remesh"])
    return shapes


def recipe_of(config: dict[str, Any]) -> Recipe:
    """What the network that a whole config describes needs of each mesh."""
    model, shot = config["model"], config["data"]["shot"]
    if "patch" in model:
        neighbourhood = {"patch": PatchRecipe(**model["patch"])}
    elif model.get("rings"):
        neighbourhood = {"rings": model["rings"]}
    else:
        neighbourhood = {"seq_len": config["seq_len"]}
    return Recipe(shot["radius"], shot["bins"], **neighbourhood)


def open_data(config: dict[str, Any]) -> CorrespondenceData:
    """The data module that a whole config describes, in plain containers. Errors: as above."""
    data = config["data"]
    store = Store(data["cache_dir"])
    return CorrespondenceData(
        open_shapes(data),
        recipe_of(config),
        store,
        config["seed"],
        data["shuffle_vertices"],
        data["workers"],
    )
