"""Where the spiral around a vertex starts: at random, or where the vertex's local frame points."""

from __future__ import annotations

from typing import Literal, Self

import torch
from pydantic import Field, model_validator

from meshspiral.geometry.shot import Frame
from meshspiral.neighbourhoods.base import Neighbourhood


class StartSettings(Neighbourhood.Settings):
    """The settings of a neighbourhood whose sequences have a start."""

    start: Literal["random", "frame"] = Field(
        description="random: drawn anew in every iteration, as in the paper; frame: where the x "
        "axis of SHOT's local frame points"
    )
    support: float = Field(
        gt=0, description="radius of that frame over the square root of the surface area"
    )
    by_area: bool = Field(
        description="the frame weighs vertices by area, so it depends less on the tessellation; "
        "SHOT as published weighs them equally"
    )
    jitter: int = Field(
        ge=0, description="start=frame: up to so many steps beside it in training, at random"
    )
    pooled: int = Field(
        ge=1,
        description="number of starts, evenly around a vertex, of which each layer takes the "
        "maximum; a step takes so many times as long",
    )

    @property
    def frame(self) -> Frame:
        """The frame that gives the start."""
        return Frame(self.support, self.by_area)

    @model_validator(mode="after")
    def _jitter_of_frame(self) -> Self:
        if self.jitter and self.start == "random":
            raise ValueError("jitter needs start=frame; start=random draws among all starts")
        return self


class StartedSequences(Neighbourhood):
    """A neighbourhood whose sequences have a start."""

    Settings = StartSettings

    @property
    def random(self) -> bool:
        return self.settings.start == "random"

    @property
    def frame(self) -> Frame | None:
        return None if self.random else self.settings.frame


def start_title(settings: StartSettings) -> str:
    """The start for titles: empty for the paper's random one."""
    pooled = f", maximum over {settings.pooled} starts" if settings.pooled > 1 else ""
    if settings.start == "random":
        return pooled
    jitter = f", jitter {settings.jitter}" if settings.jitter else ""
    return f", from the frame of support {settings.support}{jitter}{pooled}"


def draw_starts(
    counts: torch.Tensor,
    frames: torch.Tensor | None,
    jitter: int,
    generator: torch.Generator | None = None,
    pooled: int = 1,
) -> torch.Tensor:
    """Draw the starts of every vertex's spirals.

    Args:
        counts: int64 [V], the number of starts of each vertex, at least 1.
        frames: int64 [V], the start where the frame points; -1 where the frame is undefined, and
            the start is drawn from all. None: drawn from all everywhere.
        jitter: Draw from the starts at most so many steps from `frames`.
        generator: On the same device; None for torch's default.
        pooled: Number of starts S of each vertex: the one drawn, and others evenly around it.

    Returns:
        int64 [V, S], each in 0..counts - 1.
    """
    draw = torch.rand(len(counts), device=counts.device, generator=generator)
    # draw < 1, but a float32 just below 1 times the count may round up to the count
    start = (draw * counts).long().clamp(max=counts - 1)
    if frames is not None:
        width = 2 * jitter + 1
        beside = (draw * width).long().clamp(max=width - 1) - jitter
        start = torch.where(frames < 0, start, (frames + beside) % counts)
    counts = counts[:, None]
    steps = torch.arange(pooled, device=counts.device) * counts // pooled
    return (start[:, None] + steps) % counts
