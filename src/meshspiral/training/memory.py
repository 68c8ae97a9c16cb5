"""An estimate of the memory that training takes, before its first step.

A forward and backward pass on meshes of a few hundred vertices is measured and extrapolated, so
that the estimate needs to know nothing of networks and neighbourhoods.
"""

from __future__ import annotations

import copy
import logging
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.preprocessing import compute_task, neighbourhood_task
from meshspiral.data.tensors import described_tensors, draw, neighbourhood_tensors
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.loss import ROWS, linear_cross_entropy
from meshspiral.nn.networks import Network

SUBDIVISIONS = (0, 1, 2)  # of an icosahedron: 12, 42 and 162 vertices
BYTES = 60e6  # of a pass on a small mesh, at most, unless the smallest takes more

log = logging.getLogger(__name__)


class Estimate(NamedTuple):
    """The memory of training in bytes.

    Attributes:
        present: What the process has now: program, loaded meshes, weights.
        growth: What training adds at its peak: gradients, the optimizer's state, and one step.
    """

    present: int
    growth: int


def estimate_memory(net: Network, data: CorrespondenceData, precision: str) -> Estimate | None:
    """Estimate the peak memory of training. Random numbers of training stay as they are.

    Args:
        net: The network.
        data: With the training meshes loaded.
        precision: Lightning's name of it.

    Returns:
        The estimate; None if no pass on a small mesh succeeds.
    """
    train = data.datasets["train"]
    largest = train[int(train.sizes.argmax())]
    vertices = len(largest["labels"])
    net = copy.deepcopy(net).train()
    if precision == "64-true":
        net.double()
    with torch.random.fork_rng(devices=[]):
        per_vertex = _bytes_per_vertex(net, data, precision, _table_bytes(largest) / vertices)
        if per_vertex is None:
            return None
        head = _head_bytes(net, min(vertices, ROWS), precision)
    weights = sum(p.numel() * p.element_size() for p in net.parameters())
    growth = vertices * per_vertex + head + 3 * weights  # gradients, and Adam's two averages
    return Estimate(resident_bytes() or _loaded_bytes(data), int(growth))


def memory_lines(
    estimate: Estimate | None, free: int | None, device: str = "cpu"
) -> Iterator[tuple[int, str]]:
    """What to log.

    Args:
        estimate: From `estimate_memory`.
        free: Bytes that training can take; None if unknown.
        device: "cpu", or another one, which has a memory of its own.

    Yields:
        Levels of the log, and lines.
    """
    if estimate is None:
        return
    growth = f"{estimate.growth / 1e9:.2f} GB"
    if device == "cpu":
        total = (estimate.present + estimate.growth) / 1e9
        line = f"memory: about {total:.2f} GB at the peak, of which training adds {growth}"
    else:
        line = f"memory of the {device} device: training takes about {growth}"
    left = "" if free is None else f"{free / 1e9:.2f} GB are free"
    yield logging.INFO, f"{line}; {left}" if left else line
    if free is not None and estimate.growth > free:
        yield (
            logging.WARNING,
            f"training needs about {growth}, but {left}: it may be stopped for lack of memory. "
            "Smaller neighbourhoods, fewer model.channels or smaller meshes need less",
        )


def _bytes_per_vertex(
    net: Network, data: CorrespondenceData, precision: str, table: float
) -> float | None:
    """The peak of a pass through all layers but the last, per vertex.

    The smallest mesh says how large a mesh can be measured cheaply. The larger, the better: its
    spirals end later, and its rings are wider.

    Args:
        net: In the run's dtype.
        data: Its neighbourhood and channels.
        precision: Lightning's name of it.
        table: Bytes of the neighbourhood per vertex of a real mesh. Where sequences differ in
            length, those of a sphere may be shorter; the peak is corrected by the ratio.

    Returns:
        Bytes; None if the network or its neighbourhood refuses all these meshes.
    """
    found = None
    for subdivisions in SUBDIVISIONS:
        vertices = 10 * 4**subdivisions + 2
        small = found is not None and subdivisions < SUBDIVISIONS[-1]
        if found and (found * vertices > BYTES or (small and 4 * found * vertices < BYTES)):
            continue  # too expensive, or the next one is cheap enough
        try:
            batch = _small_batch(data, net.head.out_features, subdivisions)
            ratio = max(1.0, table * vertices / max(1, _table_bytes(batch)))
            batch = draw(data.neighbourhood, batch, data.seed, "memory")
            if precision == "64-true":
                batch = {k: v.double() if _is_float(v) else v for k, v in batch.items()}
            tally = _Tally(net.parameters())
            with tally, torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16-mixed"):
                x = net.embed_batch(batch)
            with tally:
                x.backward(torch.ones_like(x))
        except Exception as error:  # a neighbourhood or network may refuse so small a mesh
            log.debug("no pass on %d vertices (%r)", vertices, error)
            continue
        found = ratio * tally.peak / vertices
    return found


def _small_batch(data: CorrespondenceData, classes: int, subdivisions: int) -> Batch:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    mesh = Mesh(sphere.vertices, sphere.faces, "sphere")
    rng = np.random.default_rng(0)
    features = rng.standard_normal((len(mesh.vertices), data.in_features), dtype=np.float32)
    arrays = compute_task(neighbourhood_task(mesh, data.neighbourhood))
    return {
        **described_tensors([{"features": features}], mesh, data.features),
        **neighbourhood_tensors(mesh, data.neighbourhood, arrays),
        "labels": torch.from_numpy(rng.integers(classes, size=len(mesh.vertices))),
        "index": 0,
    }


def _head_bytes(net: Network, rows: int, precision: str) -> int:
    """The peak of the last layer with the loss, which takes ROWS vertices at a time."""
    head = net.head
    x = torch.zeros(rows, head.in_features, dtype=head.weight.dtype, requires_grad=True)
    labels = torch.zeros(rows, dtype=torch.int64)
    with _Tally([x]) as tally:
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16-mixed"):
            loss = linear_cross_entropy(x, head.weight, head.bias, labels)
        loss.backward()
    return tally.peak


class _Tally(TorchDispatchMode):
    """Counts the bytes of tensors that operations create, as long as these live.

    Args:
        others: Tensors that exist. New ones of the same size are not counted: these are gradients
            or copies, whose number does not depend on the mesh.

    Attributes:
        peak: The largest sum at a time.
    """

    def __init__(self, others: Iterable[Tensor]) -> None:
        super().__init__()
        self.peak = self._now = 0
        self._sizes = {tensor.untyped_storage().nbytes() for tensor in others}
        self._alive: dict[int, weakref.ref] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for tensor in result if isinstance(result, tuple | list) else (result,):
            if isinstance(tensor, Tensor):
                storage = tensor.untyped_storage()
                if id(storage) not in self._alive:
                    self._add(storage)
        return result

    def _add(self, storage: torch.UntypedStorage) -> None:
        key, size = id(storage), storage.nbytes()
        size = 0 if size in self._sizes else size

        def free(_: weakref.ref) -> None:
            self._alive.pop(key, None)
            self._now -= size

        self._alive[key] = weakref.ref(storage, free)
        self._now += size
        self.peak = max(self.peak, self._now)


def _is_tensor(value: Any) -> bool:
    return isinstance(value, Tensor)


def _is_float(value: Any) -> bool:
    return isinstance(value, Tensor) and value.is_floating_point()


def _tensor_bytes(values: Iterable[Any]) -> dict[int, int]:
    """The bytes of tensors at any depth, by storage: shared ones count once."""
    leaves = filter(_is_tensor, tree_leaves(list(values)))
    return {t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in leaves}


def _table_bytes(batch: Batch) -> int:
    """The bytes of a mesh's neighbourhood: all entries but those that every batch has."""
    shared = ("features", "vertices", "unit", "labels", "index", "corners", "weights")
    return sum(_tensor_bytes(v for k, v in batch.items() if k not in shared).values())


def _loaded_bytes(data: CorrespondenceData) -> int:
    return sum(dataset.kept for dataset in data.datasets.values())


# ----------------------------------------------------------------------------------- this machine


def resident_bytes() -> int | None:
    """Memory of this process; None on systems other than Linux."""
    status = Path("/proc/self/status")
    return bytes_in(status, "VmRSS") if status.exists() else None


def free_bytes_on(device: torch.device) -> int | None:
    """Memory of a device that this process can still take; None if unknown."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return free_bytes() if device.type == "cpu" else None


def free_bytes(root: Path = Path("/")) -> int | None:
    """Memory that this process can still take, within the limits of its control groups.

    Args:
        root: The root of the file system, for tests.

    Returns:
        Bytes; None on systems other than Linux.
    """
    meminfo = root / "proc/meminfo"
    if not meminfo.exists():
        return None
    return max(0, min([bytes_in(meminfo, "MemAvailable"), *_left_in_groups(root)]))


GROUP_FILES = {  # of control groups, version 2 and 1: limit, use, and what of it can be reclaimed
    "sys/fs/cgroup": ("memory.max", "memory.current", "inactive_file"),
    "sys/fs/cgroup/memory": (
        "memory.limit_in_bytes",
        "memory.usage_in_bytes",
        "total_inactive_file",
    ),
}


def _left_in_groups(root: Path) -> Iterator[int]:
    """What each control group of this process leaves, those without a limit apart."""
    groups = {"."}
    own = root / "proc/self/cgroup"
    for line in own.read_text().splitlines() if own.exists() else ():
        _, controllers, group = line.split(":", 2)
        if controllers in ("", "memory"):  # version 2, or the memory of version 1
            path = Path(group.lstrip("/"))
            groups |= {str(folder) for folder in (path, *path.parents)}
    for mount, (limit, usage, cached) in GROUP_FILES.items():
        for folder in (root / mount / group for group in groups):
            try:
                most, used = (int((folder / name).read_text()) for name in (limit, usage))
                pairs = (line.split() for line in (folder / "memory.stat").read_text().splitlines())
                yield most - used + int(dict(pairs).get(cached, 0))
            except (OSError, ValueError):  # no such group, or "max": without a limit
                continue


def bytes_in(file: Path, key: str) -> int:
    """An entry of a file of /proc, which holds lines such as `VmRSS: 1234 kB`."""
    for line in file.read_text().splitlines():
        if line.startswith(f"{key}:"):
            return 1024 * int(line.split()[1])
    raise KeyError(key)
