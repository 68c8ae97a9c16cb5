"""The page of a match: both meshes side by side, in one HTML file that needs no network.

The pages of many sources share Plotly's script instead of holding it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from meshspiral.geometry.kdtree import kd_tree
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.resample import resampled
from meshspiral.matching.job import FileMatch, LabelledScan
from meshspiral.matching.pictures import align_to_template, own_colors
from meshspiral.matching.transfer import transfer
from meshspiral.viz.colors import GREY, confidence_colors, point_colors, template_colors
from meshspiral.viz.pages import fill_page, pack_array, script_json
from meshspiral.viz.render import upright
from meshspiral.viz.sketch import png, sketch

MOST_VERTICES = 20_000  # shown of a mesh; a larger one is thinned
TIP = 0.012  # height of a mark over the surface, over its size


class Side:
    """One mesh of the page, thinned for display if it is large.

    Args:
        noun: What it is: "source", "target" or "template".
        name: Its file's name.
        mesh: The mesh as shown, W vertices, in the template's pose.
        origin: int [W], the user's vertex of each.
        confidence: float [W].
        points: float [W, 3], the point on the template of each; NaN for none.
        colors: Colours of the W vertices by name, float [W, 3].
    """

    def __init__(
        self,
        noun: str,
        name: str,
        mesh: Mesh,
        origin: np.ndarray,
        confidence: np.ndarray,
        points: np.ndarray,
        colors: dict[str, np.ndarray],
    ):
        self.noun, self.name, self.total = noun, name, len(mesh.vertices)
        shown = np.arange(len(mesh.vertices))
        if len(mesh.vertices) > MOST_VERTICES:
            thin = resampled(mesh, MOST_VERTICES)
            _, shown = kd_tree(mesh.vertices).query(thin.vertices)
            mesh = thin
        self.mesh, self.origin = mesh, origin[shown]
        self.confidence, self.points = confidence[shown], points[shown]
        self.colors = {key: values[shown] for key, values in colors.items()}

    @property
    def note(self) -> str | None:
        """A sentence on thinning; None if the mesh is shown as it is."""
        if len(self.origin) == self.total:
            return None
        return f"The {self.noun} is shown with {len(self.origin):,} of {self.total:,} vertices."

    def packed(self, up: str, counterpart: np.ndarray, apart: np.ndarray) -> dict[str, Any]:
        """The side as JSON.

        Args:
            up: The axis that points up, "y" or "z".
            counterpart: int [W], vertices of the other side as shown; -1 for none.
            apart: float [W], the distance of the two labels on the template over sqrt(area).
        """
        points = upright(self.mesh.vertices, up)
        points = points - (points.min(axis=0) + points.max(axis=0)) / 2
        normals = upright(np.nan_to_num(self.mesh.vertex_normals), up)
        return {
            "noun": self.noun,
            "points": pack_array(points.T, np.float32),
            "tips": pack_array((points + TIP * self.mesh.size * normals).T, np.float32),
            "faces": pack_array(self.mesh.faces.T, np.int32),
            "vertex": pack_array(self.origin, np.int32),
            "confidence": pack_array(self.confidence, np.float32),
            "other": pack_array(counterpart, np.int32),
            "apart": pack_array(apart, np.float32),
            "colors": {k: pack_array(np.round(255 * c), np.uint8) for k, c in self.colors.items()},
        }


Carried = tuple[np.ndarray, np.ndarray]  # colours of the target, and carried to the source


def view_html(
    sides: tuple[Side, Side], match: FileMatch, template: Mesh, up: str, script: str | None = None
) -> str:
    """The page of a match.

    Args:
        sides: Of `sides_of`.
        match: What to show.
        template: The template of the labels.
        up: The template's axis that points up, "y" or "z".
        script: The path of Plotly's script, relative to the page; None to write it into the page.
    """
    other, source = sides
    links = [_counterparts(*pair, template.size) for pair in ((other, source), (source, other))]
    found = match.source.labels.template if match.map is None else match.map
    links[1] = _mapped(source, other, found, template.size)
    if match.target is None:  # a template is as sure as the vertices that are labelled with it
        counterpart = links[0][0]
        other.confidence = np.where(counterpart < 0, 0, source.confidence[counterpart])
        other.colors["confidence"] = confidence_colors(other.confidence)
    packed = [side.packed(up, *link) for side, link in zip(sides, links, strict=True)]
    names = {"correspondence": "correspondence", "confidence": "confidence"}
    names |= {"carried": "carried from the target"} if "carried" in source.colors else {}
    return fill_page(
        Path(__file__).with_name("view.html"),
        title=f"{source.name} and {other.name}",
        names=[f"{side.noun}: {side.name}" for side in (other, source)],
        colorings=list(names.items()),
        notes=[side.note for side in (other, source) if side.note],
        data=script_json({"sides": packed}),
        script=script,
        plotly=None if script else get_plotlyjs(),
    )


def thumbnail(sides: tuple[Side, Side], up: str) -> bytes:
    """Both sides from the front by correspondence, as a small PNG that needs no OpenGL library."""
    points, faces, colors, left, count = [], [], [], 0.0, 0
    for side in sides:
        place = upright(side.mesh.vertices, up)
        place -= (place.min(axis=0) + place.max(axis=0)) / 2
        place[:, 0] += left - place[:, 0].min()
        left = place[:, 0].max() + 0.1 * side.mesh.size
        points.append(place)
        faces.append(side.mesh.faces + count)
        colors.append(side.colors["correspondence"])
        count += len(place)
    return png(sketch(*map(np.concatenate, (points, faces, colors))))


def sides_of(match: FileMatch, template: Mesh, carried: Carried | None = None) -> tuple[Side, Side]:
    """The target, or the template without one, and the source.

    Args:
        match: What to show.
        template: The template of the labels.
        carried: Colours of the target's vertices, and those carried to the source's, float [W, 3]
            and [V, 3] in 0..1; None for none.
    """
    source, target = match.source, match.target
    confidence = source.on_mesh(match.source_confidence)
    if target is None:
        colors = {"correspondence": template_colors(template)}
        everyone = np.arange(len(template.vertices))
        other = Side(
            "template",
            template.name,
            template,
            everyone,
            np.ones(len(everyone)),
            template.vertices,
            colors,
        )
        shown = point_colors(template, source.labels.points)
    else:
        own = own_colors(target.scan)
        near = target.on_mesh(target.labels.near_confidence)
        colors = {"correspondence": target.on_mesh(own), "confidence": confidence_colors(near)}
        if carried is not None:
            colors["carried"] = target.on_mesh(carried[0])
        other = _side("target", target, template, near, colors)
        shown = transfer(own, match.map, GREY)
    colors = {"correspondence": source.on_mesh(shown), "confidence": confidence_colors(confidence)}
    if target is not None and carried is not None:
        colors["carried"] = source.on_mesh(carried[1])
    return other, _side("source", source, template, confidence, colors)


def _side(
    noun: str,
    labelled: LabelledScan,
    template: Mesh,
    confidence: np.ndarray,
    colors: dict[str, np.ndarray],
) -> Side:
    scan, labels = labelled.scan, labelled.labels
    mesh = align_to_template(scan, labels, template)
    name = Path(scan.mesh.name).name
    points = labelled.on_mesh(labels.points)
    return Side(noun, name, mesh, scan.origin, confidence, points, colors)


def _counterparts(side: Side, other: Side, size: float) -> tuple[np.ndarray, np.ndarray]:
    """For every vertex of a side as shown that of the other with the nearest label, and how far."""
    counterpart, apart = np.full(len(side.origin), -1), np.full(len(side.origin), np.nan)
    known = np.isfinite(side.points).all(axis=1)
    others = np.flatnonzero(np.isfinite(other.points).all(axis=1))
    if known.any() and len(others):
        distance, nearest = kd_tree(other.points[others]).query(side.points[known])
        counterpart[known], apart[known] = others[nearest], distance / size
    return counterpart, apart


def _mapped(
    source: Side, target: Side, match: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """For every vertex of the source as shown the target vertex of the map, and how far their
    labels are; where that vertex is not shown, the one with the nearest label."""
    counterpart, apart = _counterparts(source, target, size)
    shown = np.full(max(target.origin.max(), match.max()) + 2, -1)  # the last: that of -1
    shown[target.origin] = np.arange(len(target.origin))
    mapped = shown[match[source.origin]]
    counterpart = np.where(mapped >= 0, mapped, counterpart)
    known = counterpart >= 0
    offsets = source.points[known] - target.points[counterpart[known]]
    apart[known] = np.linalg.norm(offsets, axis=1) / size
    return counterpart, apart
