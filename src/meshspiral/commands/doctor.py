"""Print what a bug report needs: `python -m src.doctor`."""

from __future__ import annotations

import importlib.metadata
import logging
import os
import platform
import shutil
from pathlib import Path

import numpy as np

from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.schema import DoctorConfig

PACKAGES = (
    "meshspiral",
    "torch",
    "lightning",
    "hydra-core",
    "numpy",
    "numba",
    "trimesh",
    "potpourri3d",
    "pyvista",
    "vtk",
    "pymeshlab",
)

log = logging.getLogger(__name__)


@entry_point("doctor", DoctorConfig)
def main(config: DoctorConfig) -> None:
    for title, value in [*software(), *hardware(), *storage(Path(config.cache_dir))]:
        log.info("%-22s %s", title, value)


def software() -> list[tuple[str, str]]:
    """Versions of the interpreter and of packages."""
    rows = [("system", platform.platform()), ("python", platform.python_version())]
    for package in PACKAGES:
        try:
            rows.append((package, importlib.metadata.version(package)))
        except importlib.metadata.PackageNotFoundError:
            rows.append((package, "not installed"))
    return rows


def hardware() -> list[tuple[str, str]]:
    """Processor, GPUs, precision, OpenGL and memory."""
    import torch

    from meshspiral.geometry.mesh import Mesh
    from meshspiral.training.device import choose_precision
    from meshspiral.training.memory import free_bytes
    from meshspiral.viz.render import RenderError, Row, render

    triangle = Mesh(np.eye(3), [[0, 1, 2]])
    try:
        render([Row([triangle], [np.eye(3)])], "y")
        opengl = "renders"
    except RenderError as error:
        opengl = str(error)
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    free = free_bytes()
    return [
        ("cores", str(os.cpu_count())),
        ("GPUs", ", ".join(gpus) or "none"),
        ("bf16 on processor", "yes" if choose_precision("auto", "cpu") == "bf16-mixed" else "no"),
        ("OpenGL", opengl),
        ("free memory", "unknown" if free is None else f"{free / 1e9:.1f} GB"),
    ]


def storage(cache_dir: Path) -> list[tuple[str, str]]:
    """Free disk space, and the cache."""
    from meshspiral.data.cache import Cache

    free = shutil.disk_usage(Path.cwd()).free
    return [
        ("free disk", f"{free / 1e9:.1f} GB"),
        ("cache", f"{cache_dir}, {Cache(cache_dir).size() / 1e6:.0f} MB"),
    ]


if __name__ == "__main__":
    main()
