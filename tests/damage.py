"""Random damage to meshes, as arrays and as bytes of files; the same for the same seed."""

from __future__ import annotations

import numpy as np
import trimesh

from meshspiral.data.mesh_files import SUFFIXES
from meshspiral.geometry.mesh import Mesh


def _pick(rng, array):
    return rng.integers(len(array), size=rng.integers(1, 2 + len(array) // 8))


def _not_finite(rng, v, f):
    v[_pick(rng, v), rng.integers(3)] = rng.choice([np.nan, np.inf, -np.inf])
    return v, f


def _far(rng, v, f):
    v[_pick(rng, v)] *= 10.0 ** rng.uniform(-40, 40)
    return v, f


def _scaled(rng, v, f):
    return v * 10.0 ** rng.uniform(-160, 160) + rng.choice([0.0, 1e3, 1e9]), f


def _collapsed(rng, v, f):
    v[_pick(rng, v)] = v[rng.integers(len(v))]
    return v, f


def _flat(rng, v, f):
    return v * [1, 1, rng.choice([0, 1e-300, 1e-12])], f


def _noisy(rng, v, f):
    return v + rng.normal(size=v.shape) * 10.0 ** rng.uniform(-6, 1), f


def _torn(rng, v, f):
    return v[f.ravel() % len(v)], np.arange(f.size).reshape(-1, 3)


def _holes(rng, v, f):
    return v, np.delete(f, _pick(rng, f), axis=0)


def _few(rng, v, f):
    return v, f[rng.integers(len(f), size=rng.integers(0, 4))]


def _repeated(rng, v, f):
    return v, np.concatenate([f, f[_pick(rng, f)]])


def _turned(rng, v, f):
    some = _pick(rng, f)
    f[some] = f[some][:, ::-1]
    return v, f


def _inside_out(rng, v, f):
    return v, f[:, ::-1]


def _wild(rng, v, f):
    reach = rng.choice([0, 0, 5])
    return v, np.concatenate([f, rng.integers(-reach, len(v) + reach, (rng.integers(1, 20), 3))])


def _degenerate(rng, v, f):
    f[_pick(rng, f), rng.integers(3)] = rng.integers(len(v))
    return v, f


def _lonely(rng, v, f):
    return np.concatenate([v, rng.normal(size=(rng.integers(1, 50), 3))]), f


def _twice(rng, v, f):
    apart = rng.choice([0.0, 1e-9, 0.5, 100.0])
    return np.concatenate([v, v + apart]), np.concatenate([f, f + len(v)])


def _pinched(rng, v, f):
    """Merge two vertices: into a bow tie, or with edges of four faces."""
    one, two = rng.integers(len(v), size=2)
    return v, np.where(f == one, two, f)


DAMAGES = [
    _not_finite,
    _far,
    _scaled,
    _collapsed,
    _flat,
    _noisy,
    _torn,
    _holes,
    _few,
    _repeated,
    _turned,
    _inside_out,
    _wild,
    _degenerate,
    _lonely,
    _twice,
    _pinched,
]


def damaged(mesh: Mesh, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of a mesh after one to four kinds of damage."""
    rng = np.random.default_rng(seed)
    vertices, faces = mesh.vertices.copy(), mesh.faces.astype(np.int64)
    with np.errstate(all="ignore"):
        for _ in range(rng.integers(1, 5)):
            if len(faces):
                damage = DAMAGES[rng.integers(len(DAMAGES))]
                vertices, faces = damage(rng, vertices, faces)
    return vertices, faces


def damaged_file(mesh: Mesh, seed: int) -> tuple[str, bytes]:
    """The suffix and content of a mesh file in which the mesh, the bytes or both are damaged."""
    rng = np.random.default_rng(seed)
    suffix = SUFFIXES[rng.integers(len(SUFFIXES))]
    vertices, faces = damaged(mesh, seed) if rng.random() < 0.7 else (mesh.vertices, mesh.faces)
    faces = np.clip(faces, 0, max(len(vertices) - 1, 0))  # trimesh cannot write others
    options = {"encoding": "ascii"} if suffix == ".ply" and rng.random() < 0.5 else {}
    with np.errstate(all="ignore"):
        try:
            data = trimesh.Trimesh(vertices, faces, process=False).export(
                file_type=suffix[1:], **options
            )
        except Exception:  # some meshes cannot be written
            data = b""
    data = data.encode() if isinstance(data, str) else bytes(data)
    if rng.random() < 0.5 and data:
        data = bytearray(data)
        match rng.integers(4):
            case 0:
                data = data[: rng.integers(len(data))]
            case 1:
                for position in rng.integers(len(data), size=rng.integers(1, 30)):
                    data[position] = rng.integers(256)
            case 2:
                start = rng.integers(len(data))
                del data[start : start + rng.integers(1, 200)]
            case 3:
                for position in rng.integers(min(len(data), 400), size=3):  # the header
                    data[position] = rng.integers(256)
    return suffix, bytes(data)
