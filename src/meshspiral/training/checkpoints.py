"""Checkpoints: written whole, read without executing anything."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from meshspiral.data.files import atomic_file
from meshspiral.experiment.run_folder import BEST, CONFIG, RunError
from meshspiral.experiment.schema import ConfigError, TrainConfig, read_stored_config
from meshspiral.geometry.mesh import Mesh

BUNDLED_RUN = Path(__file__).parents[1] / "data" / "assets" / "bodies_run"


class AtomicFiles(TorchCheckpointIO):
    """Writes checkpoints that appear whole or not at all, also if the machine or the disk fails.

    The previous checkpoint stays until the new one is complete.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options=None) -> None:
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with atomic_file(path, sync=True) as file:
                # through memory: torch.save reports a full disk as an error of its own
                buffer = io.BytesIO()
                torch.save(checkpoint, buffer)
                file.write(buffer.getbuffer())
        except OSError as error:
            reason = error.strerror or error
            raise OSError(f"cannot write the checkpoint {path} ({reason})") from error


class Checkpoint(ModelCheckpoint):
    """Lightning's, but a run folder that was moved keeps its best checkpoint when it is resumed."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        here = str(self.dirpath)
        moved = {
            name: str(Path(here, Path(state[name]).name))
            for name in ("best_model_path", "kth_best_model_path", "last_model_path")
            if state.get(name)
        }
        best = {
            str(Path(here, Path(path).name)): score
            for path, score in state.get("best_k_models", {}).items()
        }
        super().load_state_dict({**state, **moved, "dirpath": here, "best_k_models": best})


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint, by name. Nothing in it is executed.

    Raises:
        RunError: The file is missing, or is not a complete checkpoint of this program.
    """
    if not path.is_file():
        what = "no epoch has finished" if (path.parents[1] / CONFIG).is_file() else "it is no run"
        raise RunError(f"{path.parents[1]} has no {BEST}: {what}")
    try:
        saved = torch.load(path, weights_only=True, map_location="cpu", mmap=True)
        if not {"config", "in_features", "num_classes"} <= saved["hyper_parameters"].keys():
            raise KeyError("hyper-parameters are missing")
    except Exception as error:  # whatever a damaged file makes torch raise
        if "GLOBAL" in str(error):  # torch refuses to call a function that the file names
            raise RunError(
                f"{path} contains more than weights and was not opened: that could run its code"
            ) from error
        reason = (str(error).splitlines() or [repr(error)])[0][:100]
        raise RunError(f"{path} is damaged ({reason})") from error
    return saved


def config_of(saved: dict[str, Any], source: str = "the checkpoint") -> TrainConfig:
    """The config of a checkpoint. Imports no plugins.

    Args:
        saved: From `read_checkpoint`.
        source: What to call it in messages.

    Raises:
        RunError: The config is damaged, or it needs a plugin.
    """
    try:
        return read_stored_config(saved["hyper_parameters"]["config"], source)
    except ConfigError as error:
        raise RunError(str(error)) from error
    except (AttributeError, KeyError, TypeError) as error:
        raise RunError(f"{source} has a damaged config ({error!r})") from error


def template_of(saved: dict[str, Any]) -> Mesh:
    """The template whose vertices a checkpoint's network predicts.

    Raises:
        RunError: The checkpoint has no template.
    """
    try:
        arrays = {name: saved["template"][name].numpy() for name in ("vertices", "faces")}
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise RunError("the checkpoint has no template; an older version trained it") from error
    return Mesh(**arrays, name="template")
