"""The result: verdict, large figures, the front of the certificate."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.figures import mm
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.cell.settings.calibration import FEWEST_HELD_OUT
from gapbridge.bridge.document.blocks import (
    BAD,
    DOUBTFUL,
    GOOD,
    Badge,
    Block,
    Paragraph,
    Tile,
    Tiles,
    Verdict,
)
from gapbridge.bridge.report.labels import listed
from gapbridge.bridge.report.names import sentence


def summary(material: Material) -> list[Block]:
    """Return the verdict and the large figures."""
    c = material.calibration
    before, after = material.judged
    badge = Badge("Complete", GOOD) if c.complete else Badge("Not complete", DOUBTFUL)
    if not after.mean < before.mean:
        badge = Badge("No improvement", BAD)
    tiles = [
        Tile("mean error before", mm(before.mean), f"at most {mm(before.max)}"),
        Tile("mean error after", mm(after.mean), f"at most {mm(after.max)}"),
        Tile("smaller by", _times(before.mean, after.mean), f"over {len(after.norm)} readings"),
        Tile("expanded uncertainty (k = 2)", f"± {mm(material.budget.expanded)}",
             "of one coordinate of the tool"),
    ]  # fmt: skip
    text = f"Errors are those of {material.judged_on}: {material.error_meaning}."
    if not material.shows_places:
        text += (
            " Such readings show a part of where the tool is: how well its place is known "
            "stands in the uncertainty, not in these errors."
        )
    outliers = [r for r in material.judged[1].rows if r in material.outlier_rows]
    if outliers and material.held_out:
        rows = listed([str(int(r) + 1) for r in outliers])
        text += (
            f" Among them {'is reading' if len(outliers) == 1 else 'are readings'} {rows}, far "
            "beyond all others: to be measured again. The uncertainty does not count it."
        )
    asked = [] if material.session.accuracy is None else [_asked(material)]
    return [
        Verdict(badge, sentence(c.verdict)), *asked, Tiles(tuple(tiles)),
        Paragraph(text, "note"),
    ]  # fmt: skip


def _asked(material: Material) -> Verdict:
    """Return whether the accuracy asked for is met: by the farthest pose kept out of the fit."""
    asked = material.session.accuracy or 0.0
    after = material.calibration.held_out_after
    poses = len(np.unique(material.calibration.readings.pose[after.rows]))
    rule = f"Asked for: no pose kept out of the fit farther off than {mm(asked)}."
    if poses < FEWEST_HELD_OUT or not material.shows_places:
        found = (
            f"{poses} such poses were measured, expected {FEWEST_HELD_OUT} or more"
            if material.shows_places else "such readings show a part of where the tool is"
        )  # fmt: skip
        return Verdict(Badge("Not decided", DOUBTFUL), f"{rule} Not decided: {found}.")
    met = after.max <= asked
    word = Badge("Pass", GOOD) if met else Badge("Fail", BAD)
    text = (
        f"{rule} Found: at most {mm(after.max)} over {poses} poses, the instrument's noise in it."
    )
    return Verdict(word, text)


def _times(before: float, after: float) -> str:
    return f"{before / after:.1f} times" if after > 0 else "unknown"
