"""A trained network, from its checkpoint alone."""

from __future__ import annotations

from typing import Any

import torch

from meshspiral.data.datamodule import Batch, rotate
from meshspiral.experiment.runs import RunError
from meshspiral.geometry.mesh import Mesh
from meshspiral.nn.loss import Prediction
from meshspiral.training.module import Correspondence
from meshspiral.training.trainer import choose_precision, device_of


class Predictor:
    """predictor(batch, purpose) is the network's prediction for an item of `MeshDataset`, with or
    without labels, and with spirals drawn for that purpose.

    saved: of `read_checkpoint`. settings: its whole config, in plain containers. accelerator: "cpu"
    or "gpu". Errors: RunError if the weights are not those of the config, ConfigError without a
    GPU.
    """

    def __init__(self, saved: dict[str, Any], settings: dict[str, Any], accelerator: str = "cpu"):
        self.device = device_of(accelerator)
        self.precision = choose_precision(settings["trainer"]["precision"], accelerator)
        self.seed = settings["seed"]
        sizes = (saved["hyper_parameters"][key] for key in ("in_features", "num_classes"))
        self.module = Correspondence(settings, *sizes)
        try:
            self.module.load_state_dict(saved["state_dict"])
        except RuntimeError as error:
            raise RunError("the checkpoint's weights are not those of its config") from error
        dtype = torch.float64 if self.precision == "64-true" else torch.float32
        self.module.to(self.device, dtype).eval()

    def __call__(self, batch: Batch, purpose: str) -> Prediction:
        batch = self.module.transfer_batch_to_device(batch, torch.device(self.device), 0)
        batch = rotate(batch, self.seed, "spirals", purpose)
        if self.precision == "64-true":
            batch = {
                key: value.double() if key in ("features", "vertices", "unit") else value
                for key, value in batch.items()
            }
        low = torch.autocast(self.device, torch.bfloat16, enabled=self.precision == "bf16-mixed")
        with torch.inference_mode(), low:
            return self.module.predict(batch)


def template_of(saved: dict[str, Any]) -> Mesh:
    """The template whose vertices a checkpoint's network predicts. Errors: RunError without one."""
    try:
        arrays = {name: saved["template"][name].numpy() for name in ("vertices", "faces")}
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise RunError(
            "the checkpoint holds no template; it was trained by an older version"
        ) from error
    return Mesh(**arrays, name="template")
