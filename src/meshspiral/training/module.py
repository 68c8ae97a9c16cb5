"""The LightningModule: training and testing a network on correspondences to the template."""

from __future__ import annotations

import functools
import math
from itertools import chain
from typing import Any, TypeVar

import lightning as L
import numpy as np
import torch
from torch import Tensor, nn

from meshspiral.evaluation.metrics import CorrespondenceError
from meshspiral.evaluation.outcome import Result, result_of
from meshspiral.experiment.run_folder import RunError
from meshspiral.experiment.schema import OptimSettings, TrainConfig, read_stored_config
from meshspiral.geometry.digest import derived_seed
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.calibration import fit_temperature
from meshspiral.nn.loss import Points, Prediction, SoftLabels, linear_cross_entropy, predict
from meshspiral.nn.networks import Network

T = TypeVar("T")


def build_network(config: TrainConfig, in_features: int, num_classes: int) -> Network:
    """The network of a config.

    Args:
        config: Names a registered network; a config cannot name code to run.
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
    """
    network = Network.registered[config.model.name]
    neighbourhood = Neighbourhood.of(config.neighbourhood)
    return network.build(config.model, neighbourhood, in_features, num_classes)


def rate_factor(optim: OptimSettings, step: int, steps: int) -> float:
    """The learning rate of a step, over the largest.

    Cosine: linear from near 0 to 1 during warm-up, then half a cosine down to near 0. It depends on
    the step and on the length of the run alone: a run that gets more epochs continues as if it had
    had them from the start.

    Args:
        optim: The schedule and its warm-up.
        step: Number of steps before this one.
        steps: Number of steps of the run.
    """
    if optim.schedule == "constant":
        return 1.0
    warmup = max(1, round(optim.warmup * steps))
    if step < warmup:
        return (step + 1) / warmup
    return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))


SAMPLES = 2048  # about so many vertices of all validation meshes fit the temperature
CHECK_EVERY = 10  # steps between two checks of the loss on a GPU, each of which waits for it


def is_checked(device: str, batch: int, batches: int) -> bool:
    """Whether a step reads its loss: on a GPU seldom, but always before a checkpoint."""
    return device == "cpu" or batch % CHECK_EVERY == 0 or batch == batches - 1


class Correspondence(L.LightningModule):
    """Trains with cross-entropy over the template's vertices and Adam; measures geodesic errors.

    Args:
        config: A whole `TrainConfig` as a dictionary; checkpoints contain it.
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.

    Attributes:
        metrics: For "val" and "test" the metrics of the latest evaluation, by their names in
            metrics.json. Checkpoints contain those of validation.
        curves: Likewise the share of correct matches over `THRESHOLDS`.
        results: Likewise the prediction and the errors of each mesh, by its index.
        temperature: By which scores are divided for calibrated probabilities, fitted to a sample of
            each validation mesh in the latest validation. Checkpoints contain it.
    """

    def __init__(self, config: dict[str, Any], in_features: int, num_classes: int):
        super().__init__()
        self.save_hyperparameters()
        settings = read_stored_config(config, "the checkpoint")
        self.net: Network = build_network(settings, in_features, num_classes)
        self.optim = settings.optim
        self.seed = settings.seed
        self.soft_labels: SoftLabels | None = None
        self.errors = nn.ModuleDict({split: CorrespondenceError() for split in ("val", "test")})
        self.metrics: dict[str, dict[str, float]] = {}
        self.curves: dict[str, np.ndarray] = {}
        self.results: dict[str, dict[int, Result]] = {}
        self.temperature = 1.0

    def setup(self, stage: str) -> None:
        self.distances = self.trainer.datamodule.reference

    def on_fit_start(self) -> None:  # after setup, when the module is on its device
        if self.optim.soft_labels is not None:
            kernel = self.distances.heat_kernel(self.optim.soft_labels)
            self.soft_labels = SoftLabels(*(torch.from_numpy(x).to(self.device) for x in kernel))

    def on_train_start(self) -> None:
        # A checkpoint brings the rate of its own schedule; this run may have more epochs. Where it
        # has not, this is the rate that is set already.
        for scheduler in (config.scheduler for config in self.trainer.lr_scheduler_configs):
            rates = zip(scheduler.base_lrs, scheduler.lr_lambdas, strict=True)
            scheduler._last_lr = [base * factor(scheduler.last_epoch) for base, factor in rates]
            for group, rate in zip(
                scheduler.optimizer.param_groups, scheduler._last_lr, strict=True
            ):
                group["lr"] = rate

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        # Dropout depends on seed, epoch and mesh alone, as all other random choices do, so that a
        # resumed run equals an uninterrupted one.
        torch.manual_seed(derived_seed(self.seed, "dropout", self.current_epoch, batch["index"]))

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        head = self.net.head
        labels = batch["labels"]
        if self.soft_labels is not None and "corners" in batch:
            labels = Points(batch["corners"], batch["weights"])
        x = self.net.embed_batch(batch)
        loss = linear_cross_entropy(x, head.weight, head.bias, labels, self.soft_labels)
        if is_checked(self.device.type, batch_idx, self.trainer.num_training_batches):
            self._check_finite(loss.detach(), batch_idx)
        self.log("train/loss", loss, on_step=True, on_epoch=True, batch_size=1, sync_dist=True)
        return loss

    def _check_finite(self, loss: Tensor, batch_idx: int) -> None:
        if not bool(torch.isfinite(loss)):
            rate = self.optimizers().param_groups[0]["lr"]
            raise RunError(
                f"training diverged: the loss must be finite, got {float(loss)} in epoch "
                f"{self.current_epoch + 1}, step {batch_idx + 1}, at learning rate {rate:.3g}; try "
                f"a smaller optim.lr (it is {self.optim.lr:g}). Saved checkpoints are not affected"
            )

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluate("val", batch)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluate("test", batch)

    def predict(self, batch: Batch) -> Prediction:
        """Predict a vertex of the template for each vertex; the loss too if there are labels."""
        head = self.net.head
        return predict(self.net.embed_batch(batch), head.weight, head.bias, batch.get("labels"))

    def _evaluate(self, split: str, batch: Batch) -> None:
        head, labels = self.net.head, batch["labels"]
        x = self.net.embed_batch(batch)
        found = predict(x, head.weight, head.bias, labels)
        if split == "val":
            meshes = sum(self.trainer.num_val_batches) * self.trainer.world_size
            step = math.ceil(meshes * len(labels) / SAMPLES)
            # copies: views would keep a file open for each mesh that a reader process sent
            sampled_x = x[::step].to("cpu", copy=True)
            sampled_labels = labels[::step].to("cpu", copy=True)
            self._samples.append((sampled_x, sampled_labels))
        predicted = found.classes.cpu().numpy()
        self.log(f"{split}/loss", found.loss, batch_size=1, sync_dist=True)
        result = result_of(predicted, batch, self.distances)
        self.results[split][batch["index"]] = result
        self.errors[split].update(result.errors, predicted == batch["labels"].cpu().numpy())

    def on_validation_epoch_start(self) -> None:
        self.results["val"] = {}
        self._samples: list[tuple[Tensor, Tensor]] = []

    def on_test_epoch_start(self) -> None:
        self.results["test"] = {}

    def on_validation_epoch_end(self) -> None:
        self._report("val")
        samples, self._samples = self._of_all_processes(self._samples), []
        x, labels = (torch.cat(each) for each in zip(*chain(*samples), strict=True))
        weight, bias = self.net.head.weight.cpu(), self.net.head.bias.cpu()
        scores = torch.addmm(bias, x.to(weight.dtype), weight.T)
        self.temperature = fit_temperature(scores, labels)

    def on_test_epoch_end(self) -> None:
        self._report("test")

    def _report(self, split: str) -> None:
        values = self.errors[split].compute()
        self.errors[split].reset()
        self.curves[split] = values.pop("curve").cpu().numpy()
        values["geodesic_error_diameter"] = values["geodesic_error"] / self.distances.diameter
        self.metrics[split] = {f"{split}/{name}": float(value) for name, value in values.items()}
        # the metrics cover the meshes of all ranks already
        self.log_dict(self.metrics[split], batch_size=1, sync_dist=True)
        shares = self._of_all_processes(self.results[split])
        self.results[split] = {i: mesh for share in shares for i, mesh in share.items()}

    def _of_all_processes(self, value: T) -> list[T]:
        """A picklable value of each process, in the order of their ranks."""
        if self.trainer.world_size == 1:
            return [value]
        values: list[Any] = [None] * self.trainer.world_size
        torch.distributed.all_gather_object(values, value)
        return values

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
        checkpoint["temperature"] = self.temperature
        if "val" in self.curves:
            checkpoint["validation"] = (self.metrics["val"], torch.from_numpy(self.curves["val"]))

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if "validation" in checkpoint:
            self.metrics["val"], curve = checkpoint["validation"]
            self.curves["val"] = curve.numpy()

    def configure_optimizers(self) -> dict[str, Any]:
        optim = self.optim
        adam = torch.optim.Adam(self.parameters(), lr=optim.lr, betas=tuple(optim.betas))
        if optim.schedule == "constant":
            return {"optimizer": adam}
        steps = max(1, int(self.trainer.estimated_stepping_batches))
        factor = functools.partial(rate_factor, optim, steps=steps)
        schedule = torch.optim.lr_scheduler.LambdaLR(adam, factor)
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
