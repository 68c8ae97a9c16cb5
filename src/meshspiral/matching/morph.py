"""A mesh that turns into another: an animated GLB file with one morph target.

The format is glTF 2.0 (Khronos Group, "glTF 2.0 specification"): a JSON chunk that describes the
scene, and a binary chunk with its arrays.
"""

from __future__ import annotations

import json
import struct

import numpy as np

SECONDS = 4.0  # to the other shape and back
FLOAT, UINT = 5126, 5125  # component types of glTF
ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963


def morph_glb(
    vertices: np.ndarray, others: np.ndarray, faces: np.ndarray, colors: np.ndarray
) -> bytes:
    """A GLB file in which a mesh turns into another shape and back, with the y axis up.

    Args:
        vertices: float [V, 3], the shape at the beginning.
        others: float [V, 3], the other shape.
        faces: int [F, 3].
        colors: float [V, 3] in 0..1.

    Returns:
        The content of the file.
    """
    views, accessors, data = [], [], b""

    def add(array: np.ndarray, kind: str, target: int | None = None) -> int:
        nonlocal data
        raw = np.ascontiguousarray(array).tobytes()
        view = {"buffer": 0, "byteOffset": len(data), "byteLength": len(raw)}
        views.append(view | ({"target": target} if target else {}))
        accessor = {"bufferView": len(views) - 1, "count": len(array), "type": kind}
        accessor["componentType"] = UINT if array.dtype == np.uint32 else FLOAT
        if kind != "VEC4":
            rows = array.reshape(len(array), -1)
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        accessors.append(accessor)
        data += raw
        return len(accessors) - 1

    start = np.asarray(vertices, dtype=np.float32)
    offset = (np.asarray(others) - vertices).astype(np.float32)
    opaque = np.ones((len(colors), 1))
    attributes = {
        "POSITION": add(start, "VEC3", ARRAY_BUFFER),
        "COLOR_0": add(np.hstack([colors, opaque]).astype(np.float32), "VEC4", ARRAY_BUFFER),
    }
    primitive = {
        "attributes": attributes,
        "indices": add(np.asarray(faces, dtype=np.uint32).ravel(), "SCALAR", ELEMENT_BUFFER),
        "targets": [{"POSITION": add(offset, "VEC3", ARRAY_BUFFER)}],
        "material": 0,
    }
    times = add(np.array([0, SECONDS / 2, SECONDS], dtype=np.float32), "SCALAR")
    weights = add(np.array([0, 1, 0], dtype=np.float32), "SCALAR")
    scene = {
        "asset": {"version": "2.0", "generator": "meshspiral"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "morph"}],
        "meshes": [{"primitives": [primitive], "weights": [0.0]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}],
        "animations": [
            {
                "name": "morph",
                "samplers": [{"input": times, "output": weights, "interpolation": "LINEAR"}],
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
            }
        ],
        "bufferViews": views,
        "accessors": accessors,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
