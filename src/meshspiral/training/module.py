"""Training and testing a network that gives every vertex its counterpart on the template."""

from __future__ import annotations

import math
from typing import Any

import lightning as L
import numpy as np
import torch
from torch import Tensor, nn

from meshspiral.data.datamodule import Batch, derived_seed
from meshspiral.evaluation.metrics import CorrespondenceError
from meshspiral.evaluation.outcome import Result, result_of
from meshspiral.nn.geodesic import Resampling
from meshspiral.nn.layers import metric_features
from meshspiral.nn.loss import Prediction, linear_cross_entropy, predict
from meshspiral.nn.networks import GCNN3, FCSNet, LSTMNet


def build_network(model: dict[str, Any], seq_len: int, in_features: int, num_classes: int):
    """The network that a model config describes. Its names are a closed list: a checkpoint's
    config can't name code to run."""
    options = {k: v for k, v in model.items() if k not in ("name", "rings", "patch")}
    if model["name"] == "fcs":
        return FCSNet(in_features, num_classes, seq_len, **options)
    if model["name"] == "lstm":
        return LSTMNet(in_features, num_classes, **options)
    if model["name"] == "gcnn3":
        patch = model["patch"]
        return GCNN3(in_features, num_classes, rings=patch["rings"], rays=patch["rays"], **options)
    raise ValueError(f"model.name must be fcs, lstm or gcnn3, got {model['name']!r}")


class Correspondence(L.LightningModule):
    """Cross-entropy over the template's vertices; Adam.

    config: the whole composed config in plain containers, so that a checkpoint brings it along.
    in_features: channels of the descriptor. num_classes: vertices of the template.
    """

    def __init__(self, config: dict[str, Any], in_features: int, num_classes: int):
        super().__init__()
        self.save_hyperparameters()
        self.net: nn.Module = build_network(
            config["model"], config["seq_len"], in_features, num_classes
        )
        self.optim = config["optim"]
        self.seed = config["seed"]
        self.errors = nn.ModuleDict({split: CorrespondenceError() for split in ("val", "test")})
        # of the latest evaluation of each split; a checkpoint brings those of validation along
        self.figures: dict[str, dict[str, float]] = {}
        self.curves: dict[str, np.ndarray] = {}
        self.results: dict[str, dict[int, Result]] = {}  # likewise, by mesh

    def setup(self, stage: str) -> None:
        self.distances = self.trainer.datamodule.reference

    def embed(self, batch: Batch) -> Tensor:
        if "patches" in batch:
            return self.net.embed(batch["features"], Resampling(**batch["patches"]))
        metric = None
        if self.net.metric:
            metric = metric_features(batch["vertices"], batch["spirals"], batch["unit"])
        return self.net.embed(batch["features"], batch["spirals"], metric)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        # Dropout depends on seed, epoch and mesh alone, as all other chance does: a run that was
        # stopped anywhere goes on as if it had not been.
        torch.manual_seed(derived_seed(self.seed, "dropout", self.current_epoch, batch["index"]))

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        head = self.net.head
        loss = linear_cross_entropy(self.embed(batch), head.weight, head.bias, batch["labels"])
        self.log("train/loss", loss, on_step=True, on_epoch=True, batch_size=1, sync_dist=True)
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluate("val", batch)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluate("test", batch)

    def predict(self, batch: Batch) -> Prediction:
        """The vertex of the template that each vertex gets. Without labels there is no loss."""
        head = self.net.head
        return predict(self.embed(batch), head.weight, head.bias, batch.get("labels"))

    def _evaluate(self, split: str, batch: Batch) -> None:
        found = self.predict(batch)
        predicted = found.classes.cpu().numpy()
        self.log(f"{split}/loss", found.loss, batch_size=1, sync_dist=True)
        result = result_of(predicted, batch, self.distances)
        self.results[split][batch["index"]] = result
        self.errors[split].update(result.errors, predicted == batch["labels"].cpu().numpy())

    def on_validation_epoch_start(self) -> None:
        self.results["val"] = {}

    def on_test_epoch_start(self) -> None:
        self.results["test"] = {}

    def on_validation_epoch_end(self) -> None:
        self._report("val")

    def on_test_epoch_end(self) -> None:
        self._report("test")

    def _report(self, split: str) -> None:
        values = self.errors[split].compute()
        self.errors[split].reset()
        self.curves[split] = values.pop("curve").cpu().numpy()
        values["geodesic_error_diameter"] = values["geodesic_error"] / self.distances.diameter
        self.figures[split] = {f"{split}/{name}": float(value) for name, value in values.items()}
        # already over all meshes of all ranks, so nothing is left to average
        self.log_dict(self.figures[split], batch_size=1, sync_dist=True)
        if self.trainer.world_size > 1:
            shares: list[Any] = [None] * self.trainer.world_size
            torch.distributed.all_gather_object(shares, self.results[split])
            self.results[split] = {i: mesh for share in shares for i, mesh in share.items()}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        data = self.trainer.datamodule
        template = data.shapes.template
        checkpoint["template"] = {
            "vertices": torch.from_numpy(template.vertices),
            "faces": torch.from_numpy(template.faces),
        }
        checkpoint["up"] = data.shapes.up
        checkpoint["resolution"] = data.resolution
        checkpoint["processes"] = self.trainer.world_size
        if "val" in self.curves:
            checkpoint["validation"] = (self.figures["val"], torch.from_numpy(self.curves["val"]))

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if "validation" in checkpoint:
            self.figures["val"], curve = checkpoint["validation"]
            self.curves["val"] = curve.numpy()

    def configure_optimizers(self) -> dict[str, Any]:
        optim = self.optim
        adam = torch.optim.Adam(self.parameters(), lr=optim["lr"], betas=tuple(optim["betas"]))
        if optim["schedule"] == "constant":
            return {"optimizer": adam}
        steps = max(1, int(self.trainer.estimated_stepping_batches))
        warmup = max(1, round(optim["warmup"] * steps))

        def factor(step: int) -> float:
            """Linear from near 0 to 1, then half a cosine down to near 0."""
            if step < warmup:
                return (step + 1) / warmup
            return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))

        schedule = torch.optim.lr_scheduler.LambdaLR(adam, factor)
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
