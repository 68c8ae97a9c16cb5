"""Callbacks of training: progress bar, speed, pictures for TensorBoard, an orderly stop."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback, ProgressBar

from meshspiral.data.progress import Progress
from meshspiral.evaluation.metrics import THRESHOLDS
from meshspiral.experiment.run_folder import LAST, Stopped
from meshspiral.viz.colors import template_colors
from meshspiral.viz.plots import curve_figure
from meshspiral.viz.render import upright
from meshspiral.viz.sketch import sketch

# fits 80 columns with a bar: no count of steps, no words that the metrics explain
BAR_FORMAT = "{desc} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}, {rate_fmt}{postfix}"


class Bar(ProgressBar):
    """One progress bar for the whole training, with the time left and the latest validation.

    Validation and test show a bar of their own if they take longer than a second.
    """

    def __init__(self) -> None:
        super().__init__()
        self._bar: Progress | None = None

    def disable(self) -> None:
        self._enabled = False

    def enable(self) -> None:
        self._enabled = True

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        total = trainer.max_epochs * trainer.num_training_batches
        self._bar = Progress(
            total=total,
            initial=trainer.fit_loop.epoch_loop.total_batch_idx + 1,
            desc=self._epoch(trainer),
            bar_format=BAR_FORMAT,
            unit="step" if trainer.accumulate_grad_batches == 1 else "mesh",
            disable=not trainer.is_global_zero,
            dynamic_ncols=True,
        )

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._bar.set_description_str(self._epoch(trainer), refresh=False)

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        self._bar.update()

    @staticmethod
    def _epoch(trainer: L.Trainer) -> str:
        return f"Epoch {min(trainer.current_epoch + 1, trainer.max_epochs)}/{trainer.max_epochs}"

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._evaluation.close()
        values = trainer.callback_metrics
        if self._bar is not None and "val/exact_match" in values:
            self._bar.set_postfix_str(
                f"val {100 * values['val/exact_match']:.1f} %, "
                f"error {values['val/geodesic_error']:.4f}",
                refresh=False,
            )

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._close()

    def on_validation_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._begin("Validation", trainer.num_val_batches)

    def on_test_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._begin("Test", trainer.num_test_batches)

    def _begin(self, what: str, batches: list[int]) -> None:
        self._evaluation = Progress(
            total=sum(batches),
            desc=what,
            unit="mesh",
            leave=False,
            delay=1.0,
            disable=not self.trainer.is_global_zero,
        )

    def on_validation_batch_end(self, *_) -> None:
        self._evaluation.update()

    def on_test_batch_end(self, *_) -> None:
        self._evaluation.update()

    def on_test_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._evaluation.close()

    def on_exception(self, trainer, module, exception) -> None:
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class ValidateLast(Callback):
    """Validates after the last epoch, also where `trainer.val_every` does not divide the epochs."""

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        if trainer.current_epoch == trainer.max_epochs - 1:
            trainer.check_val_every_n_epoch = 1


class Speed(Callback):
    """Logs training steps per second, without validation, and measures the training time.

    Attributes:
        seconds: Training time so far with validation, summed over all parts of a resumed run.
        waiting: The part of it between two steps of an epoch: reading a mesh, and drawing its
            neighbourhoods.
    """

    def __init__(self) -> None:
        self._earlier = self.waiting = 0.0
        self._began: float | None = None

    @property
    def seconds(self) -> float:
        return self._earlier + (time.perf_counter() - self._began if self._began else 0.0)

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._began = time.perf_counter()
        self._steps, self._busy = 0, 0.0
        self._ended: float | None = None

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._earlier, self._began = self.seconds, None

    def on_train_batch_start(self, trainer, module, batch, batch_idx) -> None:
        self._started = time.perf_counter()
        if self._ended is not None:
            self.waiting += self._started - self._ended

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        self._steps += 1
        self._ended = time.perf_counter()
        self._busy += self._ended - self._started

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        if self._busy > 0:
            speed = self._steps / trainer.accumulate_grad_batches / self._busy
            module.log("train/steps_per_second", speed, batch_size=1, sync_dist=True)
        self._steps, self._busy, self._ended = 0, 0.0, None

    def state_dict(self) -> dict[str, float]:
        return {"seconds": self.seconds, "waiting": self.waiting}

    def load_state_dict(self, state: dict[str, float]) -> None:
        self._earlier, self.waiting = state["seconds"], state.get("waiting", 0.0)


class Convergence(Callback):
    """Remembers all validations of a run, also of one that was resumed.

    Attributes:
        exact: Share of exact matches on validation, by the number of epochs that were trained.
    """

    def __init__(self) -> None:
        self.exact: dict[int, float] = {}

    def epochs_to(self, share: float) -> int:
        """The first validated epoch with at least this share of the best exact matches."""
        enough = share * max(self.exact.values())
        return min(epoch for epoch, exact in self.exact.items() if exact >= enough)

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self.exact[trainer.current_epoch + 1] = module.metrics["val"]["val/exact_match"]

    def state_dict(self) -> dict[str, Any]:
        return {"exact": self.exact}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.exact = dict(state["exact"])


class Figures(Callback):
    """Draws for TensorBoard: the validation curve, and a validation shape coloured by its
    correspondence.

    It draws after the first validation, and then as often as 1 % of the training time allows; the
    test curve at the end.
    """

    SHARE = 0.01

    def __init__(self) -> None:
        self._spent, self._began = 0.0, 0.0

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._began = time.perf_counter()

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        now = time.perf_counter()
        if trainer.state.fn != "fit" or self._spent > self.SHARE * (now - self._began):
            return
        self._curve(trainer, module, "val")
        if trainer.is_global_zero and trainer.logger is not None:
            data = trainer.datamodule
            mesh = data.shape(data.shapes.names["val"][0]).mesh
            colors = template_colors(data.shapes.template)[module.results["val"][0].predicted]
            image = sketch(upright(mesh.vertices, data.shapes.up), mesh.faces, colors, 640)
            writer = trainer.logger.experiment
            writer.add_image("val/shape", image, trainer.current_epoch, dataformats="HWC")
        self._spent += time.perf_counter() - now

    def on_test_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._curve(trainer, module, "test")

    def _curve(self, trainer: L.Trainer, module: L.LightningModule, split: str) -> None:
        if trainer.is_global_zero and trainer.logger is not None:
            figure = curve_figure({split: (THRESHOLDS, module.curves[split])})
            trainer.logger.experiment.add_figure(f"{split}/curve", figure, trainer.current_epoch)


class GracefulStop(Callback):
    """Finishes the step on Ctrl-C or SIGTERM, saves last.ckpt, and raises `Stopped`.

    A second signal stops at once; last.ckpt is then that of the last complete epoch.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.signum: int | None = None
        self._before: dict[int, Any] = {}

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        for signum in (signal.SIGINT, signal.SIGTERM):
            self._before[signum] = signal.signal(signum, self._note)

    def _note(self, signum: int, frame: object) -> None:
        if self.signum is not None:
            raise Stopped(signum)
        self.signum = signum
        print("\nstopping after this step ...", file=sys.stderr)

    def on_train_batch_start(self, trainer, module, batch, batch_idx) -> None:
        # Never before the last step of an epoch: a checkpoint from there looks to Lightning like
        # one of a finished epoch. The start of an epoch is in last.ckpt already.
        if batch_idx % trainer.accumulate_grad_batches:  # gradients of part of a step are not saved
            return
        signum = self._heard(trainer)
        if signum is None or 0 < batch_idx == trainer.num_training_batches - 1:
            return
        if batch_idx > 0 or trainer.global_step == 0:
            trainer.save_checkpoint(self.folder / LAST)
        raise Stopped(signum)

    def _heard(self, trainer: L.Trainer) -> int | None:
        """The signal that reached any of the run's processes; all of them stop at the same step."""
        if trainer.world_size == 1:
            return self.signum
        anywhere = trainer.strategy.reduce_boolean_decision(self.signum is not None, all=False)
        if not anywhere:  # the others do not know of a signal that came since: next step
            return None
        return self.signum or signal.SIGTERM

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        signum = self._heard(trainer)
        self._restore()
        if signum is not None:
            raise Stopped(signum)

    def teardown(self, trainer: L.Trainer, module: L.LightningModule, stage: str) -> None:
        self._restore()

    def _restore(self) -> None:
        for signum, handler in self._before.items():
            signal.signal(signum, handler)
        self._before = {}
