"""The settings that every data set has: the config group `data`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, Field


def _as_text(value: Any) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return str(value) if number else value


# a path or name such as 2024, which YAML reads as a number
Text = Annotated[str, BeforeValidator(_as_text)]


# several names, or a single one
Names = Annotated[list[str], BeforeValidator(lambda v: [v] if isinstance(v, str) else v)]


class Strict(BaseModel, extra="forbid", strict=True, frozen=True):
    """Settings that accept their declared types alone, and no other keys."""


class ShotSettings(Strict):
    """SHOT descriptors."""

    radius: float = Field(
        gt=0, description="radius of SHOT's support over the square root of the surface area"
    )
    bins: int = Field(ge=1, description="bins of the cosine; 16 give 544 channels")
    by_area: bool = Field(
        description="weigh vertices by their areas instead of equally, as SHOT does; depends less "
        "on the tessellation"
    )


class RemeshSettings(Strict):
    """Another tessellation of every shape."""

    policy: Literal["isotropic", "adaptive", "refined", "simplified", "marching", "mixed"] = Field(
        description="kind of tessellation; mixed draws one for every shape"
    )
    vertices: int | None = Field(
        ge=12, description="vertices of a remeshed shape; null: 5000 for a template of 6890"
    )
    copies: int = Field(ge=1, description="tessellations of each training shape")


class DataSettings(Strict):
    """What every data set has; a data set's own settings are fields of a subclass."""

    name: str
    remesh: RemeshSettings | None = Field(description="remesh every shape; null: as it is")
    features: Names = Field(
        min_length=1, description="descriptors, one or a list: shot, raw, xyz (not invariant)"
    )
    shot: ShotSettings
    shuffle_vertices: bool = Field(description="renumber the vertices of every mesh at random")
    cache_dir: Text = Field(description="folder of cached results")
    half: bool = Field(description="keep descriptors as float16 in the cache: half the space")
    readers: int | None = Field(
        ge=0,
        description="processes that read meshes ahead of the steps; null: one if the meshes do not "
        "fit into half a gigabyte",
    )
    workers: int | None = Field(
        ge=1, description="processes that compute descriptors and tables; null: one per core"
    )

    def own(self) -> dict[str, Any]:
        """The settings of this data set alone: the arguments of its class."""
        shared = set(DataSettings.model_fields)
        groups = {key for key, value in self if isinstance(value, BaseModel)}  # of descriptors
        return self.model_dump(exclude=shared | groups)
