"""The base class of neighbourhoods, and their registry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import BaseModel

from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.shot import Frame

Arrays = dict[str, np.ndarray]
Batch = dict[str, Any]


class Neighbourhood(ABC):
    """Tables of which vertices stand around which, for all vertices of a mesh.

    A subclass says all about one kind of table, and registers under a name:
    `class Spiral(Neighbourhood, name="spiral")`. `compute` makes NumPy arrays of a mesh. They are
    computed once and cached; the cache key hashes the mesh, the settings and the source code.
    `tensors` turns them into batch entries. `draw` turns these into what the network reads, with
    fresh random choices in every training iteration.

    Class attributes:
        registered: All neighbourhoods, by name.
        gives: Name of the batch entry that networks read; a network fits if its `reads` equals it.
        noun: What the tables hold, in the plural, for messages; by default the name.
        modules: Modules whose source code is part of the cache key, beside that of the class and
            of all geometry that it imports.
        density_range: Meshes with up to this many times more or fewer vertices than the training
            meshes are labelled as they are; others are resampled first.
    """

    registered: ClassVar[dict[str, type[Neighbourhood]]] = {}
    name: ClassVar[str]
    gives: ClassVar[str]
    noun: ClassVar[str]
    modules: ClassVar[tuple[ModuleType, ...]] = ()
    density_range: ClassVar[float] = 1.5  # for tables that grow with the edges, as spirals do

    class Settings(BaseModel, extra="forbid", strict=True, frozen=True):
        """The config group `neighbourhood`."""

        name: str

    def __init_subclass__(cls, name: str | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if name is not None:
            cls.name = name
            cls.noun = getattr(cls, "noun", name)
            Neighbourhood.registered[name] = cls

    def __init__(self, settings: Any):
        self.settings = settings

    @staticmethod
    def of(settings: Any) -> Neighbourhood:
        """The neighbourhood that settings describe, by their name."""
        return Neighbourhood.registered[settings.name](settings)

    @property
    @abstractmethod
    def title(self) -> str:
        """A description for the log, e.g. "spirals of 20 vertices"."""

    @property
    def length(self) -> int | None:
        """Number of elements of every sequence; None if they differ, or there are no sequences."""
        return None

    @property
    def length_label(self) -> str | None:
        """The length of the sequences in plots and tables, e.g. "N = 20"; None without any."""
        return None

    @property
    def least_vertices(self) -> int:
        """Number of vertices that a mesh must have; by default the length of a sequence."""
        return self.length or 1

    @property
    def random(self) -> bool:
        """Whether `draw` makes random choices in evaluation."""
        return False

    @property
    def frame(self) -> Frame | None:
        """The local frames that it needs; None for none.

        If it is not None, `compute` and `tensors` get the frames as a further argument,
        float32 [V, 3, 3], see `local_frames`.
        """
        return None

    def mesh_key(self, mesh: Mesh) -> tuple:
        """The arrays of the mesh on which `compute` depends; by default all of it."""
        return mesh.vertices, mesh.faces, mesh.complete_area

    @abstractmethod
    def compute(self, mesh: Mesh) -> Arrays:
        """The arrays to cache.

        Args:
            mesh: The surface.

        Returns:
            NumPy arrays by name, of any shapes and dtypes.
        """

    @abstractmethod
    def tensors(self, arrays: Arrays, mesh: Mesh) -> dict[str, Any]:
        """The batch entries of a mesh.

        Args:
            arrays: What `compute` returned for it.
            mesh: The surface.

        Returns:
            Tensors by name, or dictionaries of tensors. If `draw` is not overridden, the entry
            `gives` is among them.
        """

    def draw(self, batch: Batch, generator: torch.Generator, training: bool = False) -> Batch:
        """The batch with the entry `gives`, in which random choices come from `generator`.

        Args:
            batch: Entries of `tensors`, beside others, on any device.
            generator: On the same device.
            training: Whether the batch is trained on.
        """
        return batch
