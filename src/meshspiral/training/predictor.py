"""A trained network, from its checkpoint alone."""

from __future__ import annotations

from typing import Any

import torch

from meshspiral.data.datamodule import draw
from meshspiral.experiment.run_folder import RunError
from meshspiral.experiment.schema import TrainConfig
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.loss import Prediction
from meshspiral.training.device import choose_precision, device_of
from meshspiral.training.module import Correspondence


class Predictor:
    """Predicts with the network of a checkpoint.

    Args:
        saved: From `read_checkpoint`.
        config: Its config, from `config_of`; settings of the data set may differ.
        accelerator: "cpu" or "gpu".
        votes: Number of draws of the neighbourhoods; the mean of their log-probabilities decides.

    Raises:
        RunError: The weights do not fit the config.
        ConfigError: There is no GPU.
    """

    def __init__(
        self, saved: dict[str, Any], config: TrainConfig, accelerator: str = "cpu", votes: int = 1
    ):
        self.device = device_of(accelerator)
        self.precision = choose_precision(config.trainer.precision, accelerator)
        self.seed, self.votes = config.seed, votes
        self.neighbourhood = Neighbourhood.of(config.neighbourhood)
        sizes = (saved["hyper_parameters"][key] for key in ("in_features", "num_classes"))
        self.module = Correspondence(config.model_dump(), *sizes)
        try:
            self.module.load_state_dict(saved["state_dict"])
        except RuntimeError as error:
            raise RunError("the checkpoint's weights do not fit its config") from error
        dtype = torch.float64 if self.precision == "64-true" else torch.float32
        self.module.to(self.device, dtype).eval()

    def __call__(self, batch: Batch, purpose: str) -> Prediction:
        """Predict a vertex of the template for each vertex of a mesh.

        Args:
            batch: An item of `MeshDataset`, with or without labels.
            purpose: Random choices of the neighbourhoods depend on it and on the run's seed.
        """
        batch = self.module.transfer_batch_to_device(batch, torch.device(self.device), 0)
        if self.precision == "64-true":
            batch = {
                key: value.double() if key in ("features", "vertices", "unit") else value
                for key, value in batch.items()
            }
        purposes = [(purpose,), *((purpose, "vote", k) for k in range(1, self.votes))]
        draws = (draw(self.neighbourhood, batch, self.seed, "spirals", *p) for p in purposes)
        low = torch.autocast(self.device, torch.bfloat16, enabled=self.precision == "bf16-mixed")
        with torch.inference_mode(), low:
            return self.module.predict(*draws)
