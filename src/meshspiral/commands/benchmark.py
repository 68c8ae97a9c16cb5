"""Measure what training costs: `python -m src.benchmark`, `python -m src.benchmark --help`."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from meshspiral.data.files import write_file
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.schema import BenchmarkConfig, ConfigError, TrainConfig, read_config
from meshspiral.nn.networks import Network

log = logging.getLogger(__name__)


@entry_point("benchmark", BenchmarkConfig)
def main(config: BenchmarkConfig) -> None:
    from hydra.core.hydra_config import HydraConfig

    from meshspiral.benchmarking.measure import machine
    from meshspiral.benchmarking.memory import memory_rows
    from meshspiral.benchmarking.preprocessing import preprocessing_rows
    from meshspiral.benchmarking.scaling import scaling_rows
    from meshspiral.benchmarking.steps import step_rows
    from meshspiral.benchmarking.table import table_lines
    from meshspiral.benchmarking.waiting import waiting_rows
    from meshspiral.training.device import device_of, set_up_process
    from meshspiral.viz.plots import encoded, scaling_figure

    measure = {
        "steps": step_rows,
        "memory": memory_rows,
        "preprocessing": preprocessing_rows,
        "waiting": waiting_rows,
        "scaling": scaling_rows,
    }
    folder = Path(HydraConfig.get().runtime.output_dir)
    networks = network_configs(config)
    if device_of(config.accelerator) != "cpu" and config.parts != ["steps"]:
        raise ConfigError("accelerator=gpu measures steps alone: add 'parts=[steps]'")
    set_up_process(config.threads, keep_memory=True)  # ours and the reference alike, as in training
    result = {"machine": machine(), "config": config.model_dump()}
    log.info("%s", ", ".join(f"{key} {value}" for key, value in result["machine"].items()))
    for part in config.parts:
        rows = result[part] = measure[part](config, networks)
        log.info("%s", "\n".join(table_lines(part, rows)))
        write_file(folder / "benchmark.json", json.dumps(result, indent=2) + "\n")
        curves = [row for row in rows if part == "scaling" and len(row["sizes"]) > 1]
        if curves:
            write_file(folder / "scaling.png", encoded(scaling_figure(curves), "png"))
    log.info("%s", folder / "benchmark.json")


def network_configs(config: BenchmarkConfig) -> list[TrainConfig]:
    """For each of the config's models what `train` composes for it and the config's overrides.

    Without metric information, unless an override asks for it.

    Raises:
        ConfigError: A name is not that of a registered network, or there is none.
    """
    # within a command, compose() also looks in the folders of its --config-dir
    from hydra import compose

    names = ", ".join(sorted(Network.registered))
    if not config.models:
        raise ConfigError(f"models must be of {names}, got none")
    for model in config.models:
        if model not in Network.registered:
            raise ConfigError(f"models must be of {names}, got {model}")
    common = [
        f"seq_len={config.seq_len}",
        "metric=false",
        "data=bodies",
        f"data.vertices={config.vertices}",
        f"plugins=[{','.join(config.plugins)}]",
    ]
    return [
        read_config(TrainConfig, compose("train", [f"model={model}", *common, *config.overrides]))
        for model in config.models
    ]


if __name__ == "__main__":
    main()
