"""The base class of descriptors, and their registry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import BaseModel, create_model

from meshspiral.data.settings import DataSettings
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.shot import Frame

if TYPE_CHECKING:
    import torch  # takes seconds; the command line knows descriptors without it


class Descriptor(ABC):
    """Numbers that describe the surface around each vertex of a mesh.

    A subclass registers under a name, `class Shot(Descriptor, name="shot")`, by which
    `data.features` finds it. The fields of its `Settings` are the settings `data.<name>.*`. Entries
    should be about as large as those of SHOT, 1 / sqrt(544), so that one `model.feature_scale`
    suits all.

    Class attributes:
        registered: All descriptors, by name.
        modules: Modules whose source code is part of the cache key, beside that of the class and
            of all geometry that it imports.
        fitted: Name of a setting that is fitted to the training shapes if it is null, see `fit`.
    """

    registered: ClassVar[dict[str, type[Descriptor]]] = {}
    name: ClassVar[str]
    modules: ClassVar[tuple[ModuleType, ...]] = ()
    fitted: ClassVar[str | None] = None

    class Settings(BaseModel, extra="forbid", strict=True, frozen=True):
        """The settings `data.<name>`. Those of a plugin need default values."""

    def __init_subclass__(cls, name: str | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if name is not None:
            cls.name = name
            Descriptor.registered[name] = cls

    def __init__(self, settings: Any):
        self.settings = settings

    @property
    @abstractmethod
    def channels(self) -> int:
        """Number of channels."""

    @property
    def frame(self) -> Frame | None:
        """The local frames that `compute` needs; None for none."""
        return None

    @abstractmethod
    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> np.ndarray:
        """Describe every vertex.

        Args:
            mesh: The surface, of an area above 0.
            frames: If `frame` is not None, the frames of `local_frames`, float32 [V, 3, 3].

        Returns:
            float32 [V, channels], with NaN in rows where the descriptor is undefined.
        """

    @property
    def unfitted(self) -> bool:
        """Whether `fit` must be called before `compute`."""
        return self.fitted is not None and getattr(self.settings, self.fitted) is None

    def measure(self, mesh: Mesh) -> np.ndarray:
        """What `fit` needs to know of a training shape, of any shape and dtype."""
        raise NotImplementedError

    def fit(self, measured: Sequence[np.ndarray]) -> Any:
        """The value of the setting `fitted`, from `measure` of all training shapes."""
        raise NotImplementedError

    def with_fitted(self, measured: Sequence[np.ndarray]) -> Descriptor:
        """The same descriptor with its setting fitted."""
        value = self.fit(measured)
        return type(self)(self.settings.model_copy(update={self.fitted: value}))

    def drawn(self, features: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """What an iteration of training reads; by default the features as they are.

        Args:
            features: float [V, channels], as `compute` returned them, zeros where undefined.
            generator: For random choices, on the same device.
        """
        return features


@dataclass(frozen=True, eq=False)
class Features:
    """The descriptors of a data set, side by side.

    Args:
        descriptors: In the order of the channels.
        unit: Length by which metric information is divided, over the square root of the area.
    """

    descriptors: tuple[Descriptor, ...]
    unit: float

    @staticmethod
    def of(data: DataSettings) -> Features:
        """Those that the settings of a data set name."""
        descriptors = (
            Descriptor.registered[name](getattr(data, name, None)) for name in data.features
        )
        return Features(tuple(descriptors), data.shot.radius)

    def settings_in(self, data: DataSettings) -> DataSettings:
        """The settings of a data set with those of these descriptors, which may be fitted."""
        own = {d.name: d.settings for d in self.descriptors if d.fitted}
        return data.model_copy(update=own) if own else data

    @property
    def channels(self) -> int:
        """Number of channels of all descriptors together."""
        return sum(descriptor.channels for descriptor in self.descriptors)

    def drawn(self, features: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """The features, float [V, channels], as an iteration of training reads them."""
        import torch

        columns = features.split([descriptor.channels for descriptor in self.descriptors], dim=1)
        parts = [
            descriptor.drawn(part, generator)
            for descriptor, part in zip(self.descriptors, columns, strict=True)
        ]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


@cache
def settings_with_descriptors(settings: type[DataSettings]) -> type[DataSettings]:
    """The settings of a data set, with a group of settings for every registered descriptor."""
    fields: dict[str, Any] = {}
    for name, descriptor in Descriptor.registered.items():
        if name not in DataSettings.model_fields and descriptor.Settings.model_fields:
            required = any(f.is_required() for f in descriptor.Settings.model_fields.values())
            fields[name] = (descriptor.Settings, ... if required else descriptor.Settings())
    made = create_model(settings.__name__, __base__=settings, **fields)
    made.__reduce__ = lambda self: (_read_settings, (settings, self.model_dump()))
    return made


def _read_settings(settings: type[DataSettings], values: dict[str, Any]) -> DataSettings:
    return settings_with_descriptors(settings).model_validate(values)
