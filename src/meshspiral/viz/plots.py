"""Figures by matplotlib: error curves, costs, and renders with captions.

All functions return a `Figure` that belongs to no window system; save it with `savefig`.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping

import numpy as np
from matplotlib import cycler, rc_context, rcParams
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from trimesh.graph import connected_component_labels

from meshspiral.geometry.mesh import Mesh
from meshspiral.viz.colors import ERROR_COLORS, MOST_ERROR

ERROR_LABEL = r"geodesic error / $\sqrt{\mathrm{area}}$"
DPI = 160
MOST_INSIDE = 8  # curves whose legend fits inside the axes
LONGEST_INSIDE = 36  # characters of a label that fits there
LINE = 72  # characters of a line below the axes


def curve_figure(curves: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Share of correct matches over the geodesic error threshold (Kim et al. 2011).

    Args:
        curves: By name, the thresholds over sqrt(area), float [T], and the shares in 0..1: float
            [T] of one run, or [R, T] of several, shown as mean and a band from minimum to maximum.
    """
    longest = max(map(len, curves), default=0)
    below, many = longest > LONGEST_INSIDE, len(curves) > MOST_INSIDE
    size = (7.4, max(3.6, 0.19 * len(curves) + 0.2)) if many else (4.8, 3.6)
    if below:
        curves = {textwrap.fill(name, LINE): curve for name, curve in curves.items()}
        lines = sum(name.count("\n") + 1 for name in curves)
        size = (6.0, 3.8 + 0.18 * lines)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    axes.set_prop_cycle(cycler(linestyle=("-", "--", ":", "-.")) * rcParams["axes.prop_cycle"])
    for name, (thresholds, shares) in curves.items():
        several = 100 * np.atleast_2d(shares)
        [line] = axes.plot(thresholds, several.mean(axis=0), label=name, linewidth=1.6)
        if len(several) > 1:
            axes.fill_between(
                thresholds,
                several.min(axis=0),
                several.max(axis=0),
                alpha=0.25,
                color=line.get_color(),
                linewidth=0,
            )
    axes.set(
        xlabel=ERROR_LABEL, ylabel="correct matches (%)", xlim=(0, thresholds[-1]), ylim=(0, 100)
    )
    axes.grid(alpha=0.3)
    if below:
        figure.legend(loc="outside lower center", fontsize="small")
    elif many:
        figure.legend(loc="outside right upper", fontsize="small")
    else:
        axes.legend(loc="lower right", fontsize="small")
    return figure


def all_curves_figure(thresholds: np.ndarray, shares: np.ndarray) -> Figure:
    """Curves of several runs, with an inset of their deviations from the mean curve.

    Args:
        thresholds: float [T], over sqrt(area).
        shares: float [R, T] in 0..1, a curve for each run.
    """
    figure = Figure(figsize=(4.8, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(thresholds, 100 * shares.T, color="C0", alpha=0.15, linewidth=0.8)
    axes.set(
        xlabel=ERROR_LABEL,
        ylabel="correct matches (%)",
        xlim=(0, thresholds[-1]),
        ylim=(0, 100),
        title=f"{len(shares)} runs, each with other spirals",
    )
    axes.grid(alpha=0.3)
    inset = axes.inset_axes((0.45, 0.15, 0.5, 0.4))
    inset.plot(thresholds, 100 * (shares - shares.mean(axis=0)).T, color="C0", alpha=0.15, lw=0.8)
    inset.set_title("deviation from the mean (points)", fontsize="small")
    inset.set_xlim(0, thresholds[-1])
    inset.tick_params(labelsize="small")
    inset.grid(alpha=0.3)
    return figure


def encoded(figure: Figure, kind: str) -> bytes:
    """The content of a figure's file; equal figures give equal bytes.

    Args:
        figure: The figure.
        kind: "png", "pdf" or "svg".
    """
    date = {"pdf": "CreationDate", "svg": "Date"}.get(kind)  # would differ each time
    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "figure"}):
        figure.savefig(buffer, format=kind, dpi=DPI, metadata={date: None} if date else None)
    return buffer.getvalue()


def scaling_figure(series: list[dict]) -> Figure:
    """Log-log plots of seconds and megabytes over size; dashed lines show proportionality.

    Args:
        series: As `meshspiral.benchmarking.scaling.scaling_rows` returns them.
    """
    overs, units = list(dict.fromkeys(row["over"] for row in series)), ("seconds", "MB")
    figure = Figure(figsize=(3.4 * len(overs), 6.2), layout="constrained")
    axes = figure.subplots(2, len(overs), squeeze=False)
    for column, over in enumerate(overs):
        for unit, ax in zip(units, axes[:, column], strict=True):
            for row in series:
                if row["over"] == over and None not in row[unit]:
                    label = f"{row['what']}, {row[f'exponent of {unit}']:.2f}"
                    [line] = ax.loglog(row["sizes"], row[unit], "o-", ms=3, lw=1.4, label=label)
                    end = row[unit][-1] / row["sizes"][-1]
                    ax.loglog(
                        row["sizes"],
                        [end * size for size in row["sizes"]],
                        "--",
                        lw=0.8,
                        color=line.get_color(),
                    )
            sizes = sorted({size for row in series if row["over"] == over for size in row["sizes"]})
            names = [f"{size / 1000:g} k" if size >= 1000 else str(size) for size in sizes]
            ax.minorticks_off()
            ax.set_xticks(sizes, names, fontsize="small")
            ax.set(xlabel=over, ylabel=unit)
            ax.grid(alpha=0.3)
            ax.legend(
                fontsize="small",
                title="exponent",
                title_fontsize="small",
                ncols=2,
                loc="lower center",
                bbox_to_anchor=(0.5, 1),
            )
    return figure


def picture_figure(
    images: list[np.ndarray], middles: np.ndarray, captions: list[str], bar: str | None = None
) -> Figure:
    """Renders of a row of meshes, one view below the other, with captions.

    Args:
        images: Of a `meshspiral.viz.render.Picture`.
        middles: Of the same.
        captions: A name for each mesh.
        bar: "error" or "confidence" adds the scale of these colours.
    """
    height, width = images[0].shape[:2]
    inches = width / DPI
    margin = 0.9 if bar else 0.0
    figure = Figure(figsize=(inches + margin, (height / DPI) * len(images) + 0.25))
    figure.set_dpi(DPI)
    tall = figure.get_figheight()
    share = height / DPI / tall
    for row, image in enumerate(images):
        axes = figure.add_axes((0, 1 - (row + 1) * share, inches / (inches + margin), share))
        axes.imshow(image)
        axes.axis("off")
    for middle, caption in zip(middles, captions, strict=True):
        figure.text(
            middle * inches / (inches + margin), 0.08 / tall, caption, ha="center", fontsize=8
        )
    if bar:
        axes = figure.add_axes((inches / (inches + margin), 0.2, 0.12 / (inches + margin), 0.6))
        if bar == "error":
            scale = ScalarMappable(Normalize(0, MOST_ERROR), ERROR_COLORS)
            figure.colorbar(scale, cax=axes, extend="max", label=ERROR_LABEL)
        else:
            scale = ScalarMappable(Normalize(0, 1), ERROR_COLORS.reversed())
            figure.colorbar(scale, cax=axes, label=bar)
    return figure


def neighbourhood_figure(
    panels: list[tuple[str, Mesh, int, np.ndarray]], up: str, columns: int = 2
) -> Figure:
    """Sequences of points around a point of a surface, all in its tangent plane.

    Args:
        panels: For each panel a title, a mesh, the vertex at the centre, and the points of the
            sequence, float [N, 3].
        up: The axis that points up, "y" or "z".
        columns: Number of panels side by side.
    """
    normal = np.sum([mesh.vertex_normals[v] for _, mesh, v, _ in panels], axis=0)
    plane = _tangent_plane(normal / np.linalg.norm(normal), up)  # the same view of all
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.2 * columns, 4.3 * rows), layout="constrained")
    reach = 1.15 * max(
        np.linalg.norm(p - mesh.vertices[v], axis=1).max() for _, mesh, v, p in panels
    )
    for axes, (title, mesh, v, points) in zip(
        figure.subplots(rows, columns, squeeze=False).flat, panels, strict=False
    ):
        near = np.linalg.norm(mesh.vertices - mesh.vertices[v], axis=1) < 1.6 * reach
        front = (mesh.vertex_normals @ mesh.vertex_normals[v]) > 0
        flat = (mesh.vertices - mesh.vertices[v]) @ plane.T
        shown = _connected(mesh.faces[(near & front)[mesh.faces].all(axis=1)], v, len(near))
        axes.add_collection(
            PolyCollection(flat[shown], facecolors="#f2f2f2", edgecolors="#b5b5b5", linewidths=0.7)
        )
        x, y = ((points - mesh.vertices[v]) @ plane.T).T
        order = np.arange(len(x))
        axes.plot(x, y, color="black", linewidth=0.9, zorder=2)
        axes.scatter(x, y, c=order, cmap="viridis", s=52, zorder=3)
        for i in order[:: max(1, len(order) // 26)]:
            color = "white" if i < 0.6 * len(order) else "black"
            axes.annotate(str(i), (x[i], y[i]), color=color, ha="center", va="center", fontsize=5.5)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
        axes.set_title("\n".join(textwrap.wrap(title, 60)), fontsize=8)
        axes.set_aspect("equal")
        axes.axis("off")
    return figure


def _connected(faces: np.ndarray, v: int, count: int) -> np.ndarray:
    """The faces of the connected component of vertex v, int [F, 3]."""
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    component = connected_component_labels(edges, node_count=count)
    return faces[component[faces[:, 0]] == component[v]]


def _tangent_plane(normal: np.ndarray, up: str) -> np.ndarray:
    """Two orthonormal rows that span the plane across a normal, float64 [2, 3]; the second one
    points up, as far as it can."""
    axis = np.eye(3)["xyz".index(up)]
    if abs(axis @ normal) > 0.99:  # seen from above or below
        axis = np.roll(axis, 1)
    right = np.cross(axis, normal)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(normal, right)])
