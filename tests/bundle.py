"""Make the finished run of a folder the bundled network, outside the test suite:

    python -m tests.bundle <run_folder>

Copies what `match` and `init=bundled` read, without the state of the optimizer and without what
belongs to one machine. Weights are stored in float16, in half the space. `match` computes in
float32, so that a map is the same everywhere.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import torch

from meshspiral.experiment.run_folder import BEST, CONFIG, METRICS, read_run_config, write_config
from meshspiral.experiment.schema import TrainConfig
from meshspiral.training.checkpoints import BUNDLED_RUN, config_of, read_checkpoint

KEPT = (
    "state_dict",
    "hyper_parameters",
    "template",
    "up",
    "resolution",
    "temperature",
    "validation",
    "epoch",
    "global_step",
    "pytorch-lightning_version",
)


def of_any_machine(config: TrainConfig) -> TrainConfig:
    """The config without paths, and without what only matters on one machine."""
    data = {"cache_dir": "outputs/cache", "workers": None, "readers": None}
    changes = {
        "data": config.data.model_copy(update=data),
        "trainer": config.trainer.model_copy(update={"threads": None, "precision": "32"}),
        "init": config.init and "bundled",
        "resume": None,
        "picture": True,
    }
    return config.model_copy(update=changes)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    run, bundled = parser.parse_args().run, Path(BUNDLED_RUN)
    saved = read_checkpoint(run / BEST)
    config = of_any_machine(config_of(saved, str(run)))
    kept = {key: saved[key] for key in KEPT}
    kept["state_dict"] = {key: value.half() for key, value in saved["state_dict"].items()}
    kept["hyper_parameters"] = saved["hyper_parameters"] | {"config": config.model_dump()}
    torch.save(kept, bundled / BEST)
    write_config(bundled, of_any_machine(read_run_config(run)))
    for name in (METRICS, "curve.png"):
        shutil.copy(run / name, bundled / name)
    print(f"{bundled / BEST}: {(bundled / BEST).stat().st_size / 1e6:.1f} MB")
    print(f"{bundled / CONFIG}")


if __name__ == "__main__":
    main()
