"""What a step costs, by things measured in turn: `python -m src.benchmark`."""

from __future__ import annotations

import json
import logging
import os
import platform
import tempfile
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from meshspiral.benchmarking import measure
from meshspiral.benchmarking import scaling as growing
from meshspiral.benchmarking.reference import PlainNetwork
from meshspiral.data.cache import Store
from meshspiral.data.datamodule import draw_spirals
from meshspiral.data.preprocessing import (
    PatchRecipe,
    Recipe,
    by_rows_and_columns,
    descriptor_task,
    patch_task,
    run_tasks,
    spiral_task,
)
from meshspiral.data.sources import open_shapes
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.runs import write_whole
from meshspiral.experiment.schema import ConfigError, typed
from meshspiral.nn.geodesic import Resampling
from meshspiral.nn.networks import GCNN3, FCSNet, LSTMNet
from meshspiral.training.memory import keep_freed_memory
from meshspiral.training.trainer import choose_precision, device_of
from meshspiral.viz.plots import growth_figure

log = logging.getLogger(__name__)

SHOT_RADIUS, PATCH_RADIUS = 0.16, 0.12  # as in conf/
LARGE = (20_000, 100_000)  # vertices of a mesh and of a template that must fit into memory
Row = dict[str, object]


@dataclass
class Benchmark:
    vertices: int = 6890
    seq_len: int = 20
    repeats: int = 3
    accelerator: str = "cpu"
    precision: str = "auto"
    threads: int | None = None
    parts: list[str] = field(default_factory=list)


def check(config: DictConfig) -> DictConfig:
    checked = typed(config, Benchmark)
    for key, values in {"vertices": (1500, 6890), "precision": ("32", "bf16", "auto")}.items():
        if checked[key] not in values:
            raise ConfigError(
                f"{key} must be one of {', '.join(map(str, values))}; got {checked[key]}"
            )
    for key in ("seq_len", "repeats", "threads"):
        if checked[key] is not None and checked[key] < 1:
            raise ConfigError(f"{key} must be at least 1; got {checked[key]}")
    for part in checked.parts:
        if part not in PARTS:
            raise ConfigError(f"parts must be of {', '.join(PARTS)}; got {part}")
    device_of(checked.accelerator)
    return checked


@entry_point("benchmark", check)
def main(config: DictConfig) -> None:
    from hydra.core.hydra_config import HydraConfig

    folder = Path(HydraConfig.get().runtime.output_dir)
    if config.threads:
        torch.set_num_threads(config.threads)
    torch.set_flush_denormal(True)
    keep_freed_memory()  # ours and the plain ones alike: as in training
    result: dict[str, object] = {"machine": machine(), "config": OmegaConf.to_container(config)}
    log.info("%s", ", ".join(f"{key} {value}" for key, value in result["machine"].items()))
    for part in config.parts:
        result[part] = PARTS[part](config)
        log.info("%s", "\n".join(lines(part, result[part])))
        write_whole(folder / "benchmark.json", json.dumps(result, indent=2) + "\n")
        if part == "growth":
            growth_figure(result[part]).savefig(folder / "growth.png", dpi=150)
    log.info("%s", folder / "benchmark.json")


def machine() -> dict[str, object]:
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        found = [line for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = found[0].split(":")[1].strip() if found else model
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "bf16": choose_precision("auto", "cpu") == "bf16-mixed",
        "torch": torch.__version__,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def lines(part: str, rows: list[Row]):
    """A table, one column for each key."""
    yield f"\n{part}"
    names = list(rows[0])
    cells = [[show(value) for value in row.values()] for row in rows]
    widths = [max(len(row[i]) for row in [names, *cells]) for i in range(len(names))]
    for first, *rest in [names, *cells]:
        yield "  ".join(
            [
                "",
                first.ljust(widths[0]),
                *(c.rjust(w) for c, w in zip(rest, widths[1:], strict=True)),
            ]
        )


def show(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return " ".join(map(show, value))
    return f"{value:,.{0 if value >= 100 else 3}f}" if isinstance(value, float) else str(value)


# --------------------------------------------------------------------------------------- the parts


def body(vertices: int):
    shapes = open_shapes({"name": "bodies", "vertices": vertices})
    return shapes.load(shapes.names["train"][0])


def inputs(shape, seq_len: int, device: str):
    """(features, labels, spiral table, drawn spirals, resampling), as in training."""
    mesh = shape.mesh
    recipe = Recipe(SHOT_RADIUS, 16, seq_len, patch=PatchRecipe(PATCH_RADIUS))
    tasks = [make(mesh, recipe) for make in (descriptor_task, spiral_task, patch_task)]
    shot, spirals, patches = (task.compute(*task.arguments) for task in tasks)
    patches = by_rows_and_columns(patches, len(mesh.vertices))
    to = partial(torch.as_tensor, device=device)
    table = to(spirals["sequences"]), to(spirals["first"])
    resampling = Resampling(**{name: to(array) for name, array in patches.items()})
    return to(shot["features"]), to(shape.labels), table, draw_spirals(*table), resampling


def networks(seq_len: int, classes: int) -> dict[str, torch.nn.Module]:
    return {
        "fcs": FCSNet(544, classes, seq_len, feature_scale=measure.SCALE),
        "lstm": LSTMNet(544, classes, feature_scale=measure.SCALE),
        "gcnn3": GCNN3(544, classes, feature_scale=measure.SCALE),
    }


def steps(config: DictConfig) -> list[Row]:
    """Forward, backward and Adam: ours, plain (float32), the matrix products alone."""
    device = device_of(config.accelerator)
    precision = choose_precision(config.precision, config.accelerator)
    dtype = torch.bfloat16 if precision == "bf16-mixed" else torch.float32
    features, labels, table, spirals, resampling = inputs(
        body(config.vertices), config.seq_len, device
    )
    rows = []
    for name, net in tqdm(networks(config.seq_len, config.vertices).items(), desc="Steps"):
        net, around = net.to(device), resampling if name == "gcnn3" else spirals
        plain = PlainNetwork(net).to(device)
        found = measure.products(net, config.vertices, config.seq_len)
        seconds = measure.medians(
            {
                "ours": measure.training_step(
                    net, partial(measure.fast_loss, net, features, around, labels), precision
                ),
                "plain": measure.training_step(
                    plain, partial(plain.loss, features, around, labels)
                ),
                "products": measure.multiply(found, device, dtype),
                "draw": partial(draw_spirals, *table),
            },
            config.repeats,
            device,
        )
        rows.append(
            {
                "network": name,
                "precision": precision,
                **{f"{k} ms": 1e3 * v for k, v in seconds.items()},
                "plain / ours": seconds["plain"] / seconds["ours"],
                "ours / products": seconds["ours"] / seconds["products"],
                "draw / ours": seconds["draw"] / seconds["ours"],
                "Gflop": sum(product.operations for product in found) / 1e9,
            }
        )
        del plain
    return rows


def memory(config: DictConfig) -> list[Row]:
    """The peak of an FCS-NET step beyond parameters and inputs, each in a process of its own."""
    sizes = [
        (config.vertices, config.vertices, True),
        (config.vertices, config.vertices, False),
        (*LARGE, True),
    ]
    rows = []
    for vertices, classes, ours in tqdm(sizes, desc="Memory"):
        seconds, peak = measure.in_own_process(
            measure.step_memory, vertices, classes, config.seq_len, ours
        )
        rows.append(
            {
                "vertices": vertices,
                "template": classes,
                "ours": ours,
                "seconds": seconds,
                "peak MB": peak / 1e6 if peak else None,
            }
        )
    for row in rows:
        row["over ours"] = row["peak MB"] / rows[0]["peak MB"] if row["peak MB"] else None
    return rows


def preprocessing(config: DictConfig) -> list[Row]:
    """Seconds on one core for one mesh, and with all cores for all 100 from an empty cache."""
    shapes = open_shapes({"name": "bodies", "vertices": config.vertices})
    recipe = Recipe(SHOT_RADIUS, 16, 30, patch=PatchRecipe(PATCH_RADIUS))
    makers = {"shot": descriptor_task, "spirals (30)": spiral_task, "patches": patch_task}
    mesh = shapes.load(shapes.names["train"][0]).mesh
    single = {name: make(mesh, recipe) for name, make in makers.items()}
    one = measure.medians(
        {name: partial(task.compute, *task.arguments) for name, task in single.items()},
        config.repeats,
    )
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        names = [name for split in shapes.names.values() for name in split]
        meshes = [shapes.load(name).mesh for name in names]
        tasks = (make(m, recipe) for m in meshes for make in makers.values())
        run_tasks(tasks, Store(folder), None, "Bodies")
        everything = time.perf_counter() - began
    rows: list[Row] = [{"what": name, "meshes": 1, "seconds": value} for name, value in one.items()]
    return [*rows, {"what": "all three", "meshes": len(names), "seconds": everything}]


def growth(config: DictConfig) -> list[Row]:
    """Seconds and megabytes over one size at a time, and their exponents."""
    return growing.growth(config.repeats)


PARTS = {"steps": steps, "memory": memory, "preprocessing": preprocessing, "growth": growth}


if __name__ == "__main__":
    main()
