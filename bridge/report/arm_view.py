"""The arm in space with its error arrows, drawn larger than they are."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.document.blocks import View
from gapbridge.bridge.document.drawing import EDGE, SOFT
from gapbridge.bridge.document.scene import Arrows, Path, Scene, base
from gapbridge.bridge.document.skeleton import reach, round_factor, skeleton
from gapbridge.bridge.report.material import (
    Material,
    before_and_after,
    per_sample,
    thinned,
)
from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis

ARROWS = 250
DRAWN = 4  # poses in which the arm is drawn
LENGTH = 0.18  # of the arm's reach: how long a large error's arrow is drawn


def arm_view(channel: ChannelDiagnosis, material: Material) -> View:
    """Return the arm at a few poses, with the TCP's error before and after at many."""
    selection = channel.selection
    gap, after = channel.gap[selection.kept][:, :3], channel.remaining[selection.kept][:, :3]
    rows = selection.observation.rows[selection.kept]
    q = material.log.require("actual_q", "target_q")[rows]
    tip = selection.observation.measured[selection.kept][:, :3] - gap  # where the model puts it
    keep = thinned(per_sample(gap, 3), ARROWS)
    rigid = material.model.without_terms()
    large = float(np.quantile(per_sample(gap, 3), 0.95))
    factor = round_factor(LENGTH * reach(rigid) / max(large, 1e-9))
    chosen = _apart(tip, DRAWN)
    arms = [
        Path(skeleton(rigid, q[i]), EDGE if k else SOFT, 3.0 if k else 7.0, dots=True)
        for k, i in enumerate(chosen)
    ]  # fmt: skip
    errors = before_and_after(channel, gap, after)
    scene = Scene(
        "The arm with the tool's errors as arrows",
        (*base(reach(rigid)), *reversed(arms)),
        tuple(Arrows(tip[keep], tip[keep] + e[keep] * factor, colour) for _, e, colour in errors),
        (("arm", SOFT), *((f"error {name}", colour) for name, _, colour in errors)),
    )
    drawn = f" {len(keep)} of {len(gap)} samples are drawn." if len(keep) < len(gap) else ""
    return View(
        scene,
        f"The arm at {len(chosen)} of its poses; arrows show where the tool really was, drawn "
        f"{factor:,.0f} times larger than they are. Drag to turn; click, then scroll to zoom. "
        f"Base frame, squares of the floor 0.1 or 0.25 m.{drawn}",
    )


def _apart(points: Array, count: int) -> Index:
    """Return indices of points far from each other."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)
