"""Test a finished run again, and draw it: `python -m src.evaluate run=<run folder>`."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from meshspiral.data.cache import digest
from meshspiral.data.shapes import DataError
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.runs import BEST, RunError, read_checkpoint, write_metrics, write_whole
from meshspiral.experiment.schema import ConfigError, checked, typed

KINDS = ("png", "pdf", "svg")  # of a figure
OURS = [
    "errors.png",
    "correspondence.png",
    *(f"{figure}.{kind}" for figure in ("curve", "rotations") for kind in KINDS),
]

log = logging.getLogger(__name__)


@dataclass
class Evaluate:
    run: str | None = None
    data: Any = None
    rotations: int = 0
    shapes: Any = 4
    accelerator: str = "cpu"
    threads: int | None = None


def check(config: DictConfig) -> DictConfig:
    plain = OmegaConf.to_container(config, resolve=True)
    data = plain.pop("data", None)
    found = typed(OmegaConf.create(plain), Evaluate)
    found.data = data
    if not found.run:
        raise ConfigError(
            "run= is missing: the folder of a run, such as outputs/2026-01-31/..._fcs"
        )
    if found.rotations < 0 or found.rotations == 1:
        raise ConfigError(f"rotations must be 0 or at least 2, to compare; got {found.rotations}")
    if found.threads is not None and found.threads < 1:
        raise ConfigError(f"threads must be at least 1; got {found.threads}")
    shapes = (
        OmegaConf.to_container(found.shapes) if OmegaConf.is_list(found.shapes) else found.shapes
    )
    count = isinstance(shapes, int) and not isinstance(shapes, bool) and shapes >= 0
    names = isinstance(shapes, list) and all(isinstance(name, str) for name in shapes)
    if not (count or names):
        raise ConfigError(
            f"shapes must be a number of test shapes, or a list of names; got {shapes}"
        )
    return found


@entry_point("evaluate", check)
def main(config: DictConfig) -> None:
    folder = evaluate(config)
    log.info("Written to:  %s", folder)


def evaluate(config: DictConfig) -> Path:
    """Test, write and draw. Returns the folder of what it wrote, within that of the run."""
    import torch

    from meshspiral.evaluation import summary
    from meshspiral.evaluation.metrics import THRESHOLDS
    from meshspiral.evaluation.outcome import ERRORS, Outcome, json_ready, rotations
    from meshspiral.viz.plots import all_curves_figure, encoded

    if config.threads:
        torch.set_num_threads(config.threads)
    torch.set_flush_denormal(True)
    run = Path(config.run)
    if not run.is_dir():
        raise RunError(f"run={run}: is not a folder")
    saved = read_checkpoint(run / BEST)
    trained = saved["hyper_parameters"]["config"]
    asked = OmegaConf.to_container(config.data) if config.data else {}
    settings = OmegaConf.to_container(merged(trained, asked))
    name = settings["model"]["name"]
    if config.rotations and "patch" in settings["model"]:
        raise ConfigError(f"rotations= is for networks on spirals; {name} has none")
    predict = predictor(saved, settings, config.accelerator)
    data = opened(settings, saved, asked)

    items, names = data.datasets["test"].items, data.shapes.names["test"]
    chosen = selected(config.shapes, names)
    progress = tqdm(range(len(items)), desc="Test", unit="mesh", leave=False, delay=1.0)
    results = {i: predict(data, i, "evaluation") for i in progress}
    outcome = Outcome.of(names, items, results, data.reference.diameter)
    figures, curve = outcome.figures()
    metrics = json_ready(figures, "test")

    folder = run / "evaluation" / place(settings["data"], trained["data"], asked)
    folder.mkdir(parents=True, exist_ok=True)
    for old in OURS:  # of another evaluation, beside the figures of this one
        (folder / old).unlink(missing_ok=True)
    outcome.save(folder / ERRORS)
    for line in summary.table(outcome, metrics):
        log.info(line)
    if config.rotations:
        progress = tqdm(range(config.rotations), desc="Rotations", unit="run")
        runs = ([predict(data, i, f"rotation {r}") for i in range(len(items))] for r in progress)
        found = rotations(runs, [item["labels"].numpy() for item in items])
        metrics |= json_ready(found.figures(), "rotations")
        figure = all_curves_figure(THRESHOLDS, found.curves)
        for kind in KINDS:
            write_whole(folder / f"rotations.{kind}", encoded(figure, kind))
        for line in told(found):
            log.info(line)
    write_metrics(folder, metrics)
    summary.draw(folder, {"test": curve}, outcome, data, chosen, KINDS)
    return folder


def merged(trained: dict[str, Any], asked: dict[str, Any]) -> DictConfig:
    """The config of the run, with the data set that is asked for instead of its own."""
    anywhere = ("root", "cache_dir", "workers")  # null: as in the run
    given = {key: value for key, value in asked.items() if value is not None or key not in anywhere}
    of_all = ("shot", "shuffle_vertices", "cache_dir", "workers")
    kept = {k: v for k, v in trained["data"].items() if "name" not in given or k in of_all}
    return checked(OmegaConf.create(trained | {"data": OmegaConf.merge(kept, given)}))


def place(data: dict[str, Any], trained: dict[str, Any], asked: dict[str, Any]) -> str:
    """The name of a folder for that data set; another for another one of the same name."""
    what = {k: v for k, v in data.items() if k not in ("cache_dir", "workers")}
    if "name" not in asked or all(trained.get(k) == v for k, v in what.items()):
        return data["name"]
    return f"{data['name']}-{digest(json.dumps(what))[:8]}"


def opened(settings: dict[str, Any], saved: dict[str, Any], asked: dict[str, Any]):
    """The data with its test shapes ready. Errors: RunError if its labels mean another template."""
    import numpy as np

    from meshspiral.data.sources import open_data
    from meshspiral.training.predictor import template_of

    try:
        data = open_data(settings)
    except DataError as error:
        if "name" in asked:
            raise
        raise DataError(f"{error}; if the data set has moved: data.root=") from error
    template = template_of(saved)
    same = np.array_equal(template.vertices, data.shapes.template.vertices)
    if not (same and np.array_equal(template.faces, data.shapes.template.faces)):
        classes = saved["hyper_parameters"]["num_classes"]
        raise RunError(
            f"the labels of {settings['data']['name']} mean the {data.num_classes} vertices of "
            f"another template than the one of {classes} that this run was trained on"
        )
    data.prepare(["test"])
    return data


def predictor(saved: dict[str, Any], settings: dict[str, Any], accelerator: str):
    """A trained network: predict(data, i, purpose) tests mesh i of the data's test set, with
    spirals drawn for that purpose. Arguments: as for `Predictor`."""
    from meshspiral.evaluation.outcome import result_of
    from meshspiral.training.predictor import Predictor

    network = Predictor(saved, settings, accelerator)

    def predict(data, i: int, purpose: str):
        batch = data.datasets["test"][i]
        return result_of(network(batch, purpose).classes.cpu().numpy(), batch, data.reference)

    return predict


def selected(shapes: int | list[str], names: list[str]) -> list[str]:
    """The test shapes to draw. Errors: ConfigError for one that is not there."""
    from meshspiral.evaluation.outcome import evenly

    if isinstance(shapes, int):
        return evenly(names, shapes) if shapes else []
    for name in shapes:
        if name not in names:
            raise ConfigError(f"shapes: {name} is no test shape; there are: {', '.join(names)}")
    return list(shapes)


def told(found) -> list[str]:
    """The figures of other rotations, in lines."""
    exact, error = 100 * found.exact_match, found.geodesic_error
    return [
        f"With {len(exact)} other spirals for every vertex",
        f"  exact match           {exact.mean():.2f} % (spread {exact.std():.2f}, "
        f"{exact.min():.2f} to {exact.max():.2f})",
        f"  mean geodesic error   {error.mean():.4f} (spread {error.std():.4f}, "
        f"{error.min():.4f} to {error.max():.4f})",
        f"  predicted alike in all {100 * found.unchanged:.2f} % of the vertices",
    ]


if __name__ == "__main__":
    main()
