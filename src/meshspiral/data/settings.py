"""The settings that every data set has: the config group `data`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, Field, field_validator


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
        description="weigh vertices by area, which depends less on the tessellation; SHOT as "
        "published weighs them equally"
    )


class RemeshSettings(Strict):
    """Another tessellation of every shape."""

    policy: Literal[
        "isotropic", "adaptive", "refined", "simplified", "marching", "fused", "mixed", "scans"
    ] = Field(
        description="kind of tessellation; mixed draws one of the first five for every shape, "
        "scans of all six"
    )
    vertices: int | list[int] | None = Field(
        description="vertices of a remeshed shape, or a range, from which each draws its number; "
        "null: 5000 for a template of 6890"
    )
    copies: int = Field(ge=1, description="tessellations of each training shape")
    shared: int | None = Field(
        ge=1,
        description="tessellations that registered training shapes share, which saves remeshing "
        "each; null: every shape has its own",
    )

    @field_validator("vertices")
    @classmethod
    def _enough(cls, vertices: int | list[int] | None) -> int | list[int] | None:
        if isinstance(vertices, list):
            if len(vertices) != 2 or not 12 <= vertices[0] <= vertices[1]:
                raise ValueError("must be a number of at least 12, or a range [least, most]")
        elif vertices is not None and vertices < 12:
            raise ValueError("must be at least 12")
        return vertices


class DamageSettings(Strict):
    """Damage of the training shapes, drawn for each. Lengths are over sqrt(area)."""

    noise: float = Field(ge=0, description="largest standard deviation of the vertices' noise")
    warp: float = Field(
        ge=0, le=0.05, description="largest amplitude of a smooth warp, over its wavelength"
    )
    bumps: float = Field(ge=0, le=1, description="largest slope of random bumps (root mean square)")
    share: float = Field(ge=0, le=1, description="share of the shapes that lose parts")
    cut: float = Field(ge=0, le=1, description="share of these that are cut by a plane")
    holes: int = Field(ge=0, description="largest number of holes in these")
    hole_radius: float = Field(ge=0, description="largest radius of a hole")
    extremities: float = Field(
        ge=0, le=1, description="share of these that lose a hand, a foot or the head"
    )
    component: float = Field(
        ge=0, le=1, description="share of these that lose a piece, if they consist of several"
    )
    missing: float = Field(ge=0, lt=1, description="largest share of their faces that is removed")
    size: float = Field(
        ge=0, description="largest relative error of the known size, by which radii are scaled"
    )
    seed: int = Field(ge=0, description="seed of the damage")


class DataSettings(Strict):
    """What every data set has; a data set's own settings are fields of a subclass."""

    name: str
    remesh: RemeshSettings | None = Field(description="remesh every shape; null: as it is")
    damage: DamageSettings | None = Field(
        description="damage the training shapes as scans are; null: as they are"
    )
    features: Names = Field(
        min_length=1,
        description="descriptors, one or a list: shot, geovec, hks, raw, xyz (not invariant)",
    )
    shot: ShotSettings
    shuffle_vertices: bool = Field(description="renumber the vertices of every mesh at random")
    cache_dir: Text = Field(description="folder of cached results")
    fresh: bool = Field(
        description="train each epoch on other people (anny), tessellations (remesh) and damage"
    )
    half: bool = Field(description="keep descriptors as float16 in the cache: half the space")
    readers: int | None = Field(
        ge=0,
        description="processes that read meshes ahead of the steps; null: one if the meshes do not "
        "fit into half a gigabyte, with fresh=true all cores but one",
    )
    workers: int | None = Field(
        ge=1, description="processes that compute descriptors and tables; null: one per core"
    )

    def own(self) -> dict[str, Any]:
        """The settings of this data set alone: the arguments of its class."""
        shared = set(DataSettings.model_fields)
        groups = {key for key, value in self if isinstance(value, BaseModel)}  # of descriptors
        return self.model_dump(exclude=shared | groups)
