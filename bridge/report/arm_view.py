"""The arm in 3D with its error arrows, drawn larger than they are."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapbridge.bridge.report.fragment import AFTER, BEFORE, Figure
from gapbridge.bridge.report.material import Array, Index, Material, per_sample, thinned
from gapbridge.core.diagnosis.diagnosis import ChannelDiagnosis
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix

ARROWS = 250
DRAWN = 4  # poses in which the arm is drawn
LENGTH = 0.18  # of the arm's reach: how long a large error's arrow is drawn
HEAD = 0.35  # of an arrow's length
ARM = "#5b6770"


def joint_origins(model: Model, q: Array) -> Array:
    """Return base, joints, flange and TCP (n + 3, 3) of the effect-free arm at ``q`` (n,), m."""
    at = np.eye(4)
    points = [at[:3, 3]]
    for i, link in enumerate(model.arm.link_in_link):
        at = at @ link
        points.append(at[:3, 3])
        if i < model.arm.n:
            turn = np.eye(4)
            turn[:3, :3] = rotation_matrix(np.array([[0.0, 0.0, q[i]]]))[0]
            at = at @ turn
    points.append((at @ model.tool_in_flange)[:3, 3])
    return np.array(points)


def arm_figure(channel: ChannelDiagnosis, material: Material) -> Figure:
    """Return the arm at a few poses, with the TCP's error before and after at many."""
    selection = channel.selection
    gap, after = channel.gap[selection.kept][:, :3], channel.remaining[selection.kept][:, :3]
    rows = selection.observation.rows[selection.kept]
    q = material.log.require("actual_q", "target_q")[rows]
    tip = selection.observation.measured[selection.kept][:, :3] - gap  # where the model puts it
    keep = thinned(per_sample(gap, 3), ARROWS)
    factor = _factor(gap, material.model)
    most = HEAD * LENGTH * _reach(material.model) / 2
    traces = [_arm(material.model, q[i], first=k == 0) for k, i in enumerate(_apart(tip, DRAWN))]
    given = [("error before", gap, BEFORE)] + (
        [("error after", after, AFTER)] if channel.causes else []
    )
    for name, error, colour in given:
        traces += _arrows(name, tip[keep], error[keep] * factor, colour, most)
    layout = {
        "margin": {"l": 0, "r": 0, "t": 8, "b": 0},
        "scene": _scene(),
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "top"},
        "hovermode": False,
    }
    drawn = f" {len(keep)} of {len(gap)} samples are drawn." if len(keep) < len(gap) else ""
    return Figure(
        traces, layout, f"The arm at a few of its poses; arrows show where the tool really was, "
        f"drawn {factor:,.0f} times larger than they are. Drag to turn, pinch or scroll to "
        f"zoom. Axes in metres, base frame.{drawn}", height=520,
    )  # fmt: skip


def _reach(model: Model) -> float:
    return max(float(np.linalg.norm(model.arm.link_in_link[:, :3, 3], axis=1).sum()), 0.1)


def _factor(gap: Array, model: Model) -> float:
    large = float(np.quantile(per_sample(gap, 3), 0.95))
    rough = LENGTH * _reach(model) / max(large, 1e-9)
    size = 10 ** np.floor(np.log10(max(rough, 1.0)))
    return float(max(np.floor(rough / size) * size, 1.0))


def _apart(points: Array, count: int) -> Index:
    """Return indices of points far from each other."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def _arm(model: Model, q: Array, *, first: bool) -> dict[str, Any]:
    x, y, z = joint_origins(model, q).T
    return {
        "type": "scatter3d", "mode": "lines+markers", "x": x, "y": y, "z": z, "name": "arm",
        "legendgroup": "arm", "showlegend": first, "opacity": 0.9 if first else 0.35,
        "line": {"color": ARM, "width": 10 if first else 6},
        "marker": {"color": ARM, "size": 5 if first else 3},
    }  # fmt: skip


def _arrows(
    name: str, start: Array, vector: Array, colour: str, most: float
) -> list[dict[str, Any]]:
    """Return shafts and heads; ``most`` is the longest head, m."""
    gap = np.full(len(start), np.nan)
    end = start + vector
    lines = [np.column_stack([start[:, i], end[:, i], gap]).ravel() for i in range(3)]
    shaft = {
        "type": "scatter3d", "mode": "lines", "x": lines[0], "y": lines[1], "z": lines[2],
        "name": name, "legendgroup": name, "line": {"color": colour, "width": 5},
    }  # fmt: skip
    long = np.linalg.norm(vector, axis=1, keepdims=True)
    vector = vector * np.minimum(HEAD, most / np.maximum(long, 1e-300))
    head = {
        "type": "cone", "x": end[:, 0], "y": end[:, 1], "z": end[:, 2], "u": vector[:, 0],
        "v": vector[:, 1], "w": vector[:, 2], "anchor": "tip", "sizemode": "raw",
        "sizeref": 2, "showscale": False,
        "colorscale": [[0, colour], [1, colour]], "name": name, "legendgroup": name,
        "showlegend": False, "hoverinfo": "skip",
    }  # fmt: skip
    return [shaft, head]


def _scene() -> dict[str, Any]:
    axis = {"backgroundcolor": "rgba(0,0,0,0)", "gridcolor": "#dfe4e8", "zerolinecolor": "#b9c2c9"}
    return {
        "aspectmode": "data", "dragmode": "turntable",
        "xaxis": axis | {"title": {"text": "x"}}, "yaxis": axis | {"title": {"text": "y"}},
        "zaxis": axis | {"title": {"text": "z"}},
        "camera": {"eye": {"x": 1.35, "y": 1.15, "z": 0.6}, "center": {"x": 0, "y": 0, "z": -0.12}},
    }  # fmt: skip
