"""HTML pages from templates, and the data inside them."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader


def fill_page(template: Path, **values: Any) -> str:
    """The text of a Jinja template, with its values escaped for HTML."""
    environment = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template.name).render(values)


def script_json(value: Any) -> str:
    """JSON for a script element, which no text in it can end."""
    return json.dumps(value).replace("<", "\\u003c")


def pack_array(array: np.ndarray, dtype: type) -> str:
    """The entries of an array row by row, little-endian, in base64."""
    little = np.ascontiguousarray(array, dtype=np.dtype(dtype).newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode()
