"""A trained network, from its checkpoint alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshspiral.data.tensors import draw
from meshspiral.evaluation.distributions import Distributions
from meshspiral.experiment.run_folder import RunError
from meshspiral.experiment.schema import TrainConfig
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.loss import Prediction, predict
from meshspiral.training.device import choose_precision, device_of
from meshspiral.training.module import Correspondence


class Predictor:
    """Predicts with the network of a checkpoint.

    Args:
        saved: From `read_checkpoint`.
        config: Its config, from `config_of`; settings of the data set may differ.
        accelerator: "cpu" or "gpu".
        votes: Number of draws of the neighbourhoods; the mean of their log-probabilities decides.
        calibrated: Divide scores by the checkpoint's temperature, if it has one.

    Attributes:
        temperature: By which scores are divided.

    Raises:
        RunError: The weights do not fit the config.
        ConfigError: There is no GPU.
    """

    def __init__(
        self,
        saved: dict[str, Any],
        config: TrainConfig,
        accelerator: str = "cpu",
        votes: int = 1,
        calibrated: bool = False,
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
        self.temperature = saved.get("temperature", 1.0) if calibrated else 1.0

    def __call__(self, batch: Batch, purpose: str) -> Prediction:
        """Predict a vertex of the template for each vertex of a mesh.

        Args:
            batch: An item of `MeshDataset`, with or without labels.
            purpose: Random choices of the neighbourhoods depend on it and on the run's seed.
        """
        return self.predict(self._embeddings(batch, purpose), batch.get("labels"))

    def distributions(self, batch: Batch, purpose: str) -> Distributions:
        """Predict a distribution over the template's vertices; arguments as above."""
        mean = torch.stack(self._embeddings(batch, purpose)).mean(0)  # the last layer is linear
        rows = np.arange(len(mean))
        return Distributions(mean, *self.head, rows, temperature=self.temperature)

    def _embeddings(self, batch: Batch, purpose: str) -> list[Tensor]:
        purposes = [(purpose,), *((purpose, "vote", k) for k in range(1, self.votes))]
        return [self.embed(batch, *each) for each in purposes]

    def embed(self, batch: Batch, *purpose: int | str) -> Tensor:
        """The input of the last layer for each vertex of a mesh, float [V, C].

        Args:
            batch: As above.
            *purpose: As above; several parts.
        """
        batch = self.module.transfer_batch_to_device(batch, torch.device(self.device), 0)
        batch = draw(self.neighbourhood, batch, self.seed, "spirals", *purpose)
        if self.precision == "64-true":
            batch = {
                key: value.double() if key in ("features", "vertices", "unit") else value
                for key, value in batch.items()
            }
        low = torch.autocast(self.device, torch.bfloat16, enabled=self.precision == "bf16-mixed")
        with torch.inference_mode(), low:
            return self.module.net.embed_batch(batch)

    def predict(self, embedding: Tensor | list[Tensor], labels: Tensor | None = None) -> Prediction:
        """Predict from the input of the last layer.

        Args:
            embedding: From `embed`; of several, the mean of their log-probabilities decides.
            labels: Class indices, int64 [V], or None.
        """
        labels = None if labels is None else labels.to(self.device)
        with torch.inference_mode():
            return predict(embedding, *self.head, labels)

    @property
    def head(self) -> tuple[Tensor, Tensor]:
        """Weight [K, C] and bias [K] of the last layer, over the temperature."""
        head = self.module.net.head
        return head.weight.detach() / self.temperature, head.bias.detach() / self.temperature
