"""Which of a source's joints is which of the arm's: by name, never by position."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

from gapbridge.core.errors import LogOptionError

UR_JOINTS = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint",
    "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
)  # fmt: skip
SO_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
FINGERS = 2  # numbered joints beside an arm's that a gripper may have
NUMBERED = re.compile(r"(.*?)(\d+)(\D*)$")


def order_joints(
    path: Path, found: Sequence[str], arm_joints: Sequence[str], chosen: Sequence[str]
) -> tuple[str, ...]:
    """Return the source's names in the order of the arm's joints.

    ``found``: the names in the source (more than the arm's, where a gripper is among them);
    ``arm_joints``: those of the arm, () where unknown; ``chosen``: what the user says. Without
    either, names that are a UR's or an SO-101's, or one stem with numbers from 0 or 1 on, say their
    order themselves. Raises LogOptionError where the names do not.
    """
    if chosen:
        for name in chosen:
            if chosen.count(name) > 1:
                raise LogOptionError(f"{path}: --joints: found {name} twice, expected it once")
        return tuple(_one(path, name, found) for name in chosen)
    for names in (tuple(arm_joints), UR_JOINTS, SO_JOINTS):
        if matched := _matched(names, found):
            return matched
    if numbered := _numbered(found, len(arm_joints)):
        return numbered
    expected = f"those of the arm ({', '.join(arm_joints)})" if arm_joints else "a known order"
    raise LogOptionError(
        f"{path}: joints: found {', '.join(found) or 'none'}, expected {expected}; "
        "name them in the order of the arm's joints with --joints"
    )


def _one(path: Path, name: str, found: Sequence[str]) -> str:
    if name in found:
        return name
    near = difflib.get_close_matches(name, found, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise LogOptionError(
        f"{path}: --joints: found {name}, expected one of {', '.join(found)}{hint}"
    )


def _matched(names: Sequence[str], found: Sequence[str]) -> tuple[str, ...]:
    """Return the names as the source has them, a prefix such as ``left_`` allowed; () if not all.

    A name that fits two joints (two arms in one bag) is no match.
    """
    matched = []
    for name in names:
        exact = [one for one in found if one == name]
        ending = exact or [one for one in found if one.endswith(f"_{name}") or one == f"{name}.pos"]
        if len(ending) != 1:
            return ()
        matched.append(ending[0])
    return tuple(matched)


def _numbered(found: Sequence[str], count: int) -> tuple[str, ...]:
    """Return names that are one stem with consecutive numbers, in their order; () if not."""
    by_stem: dict[tuple[str, str], dict[int, str]] = {}
    for name in found:
        if match := NUMBERED.fullmatch(name):
            by_stem.setdefault((match[1], match[3]), {})[int(match[2])] = name
    whole = [
        [numbers[i] for i in sorted(numbers)]
        for numbers in by_stem.values()
        if min(numbers) in (0, 1)
        and max(numbers) - min(numbers) + 1 == len(numbers)
        and (len(numbers) == count if count else len(numbers) >= 2)
    ]
    whole.sort(key=len, reverse=True)
    alone = len(whole) == 1 or (len(whole) > 1 and len(whole[1]) <= FINGERS < len(whole[0]))
    return tuple(whole[0]) if alone else ()
