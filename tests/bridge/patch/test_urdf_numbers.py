"""Numbers of a URDF that cannot be used: one line that names joint or link, key and number."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from cli_runs import refused

from benchmarks.patch.arms import UR_JOINTS, urdf
from gapbridge.core.arm import builtin_arm

CELL = """
robot: {model: ur10e}
effects:
  - {effect: joint_offset, joint: 3, parameters: {value: 0.004}}
  - {effect: coulomb_friction, joint: 2, parameters: {value: 4.0}}
  - {effect: link_inertia, joint: 3, parameters: {value: 0.1}}
  - {effect: link_cog, joint: 2, parameters: {x: 0.4, y: -0.2, z: 0.1}}
"""
JOINT = f'<joint name="{UR_JOINTS[1]}" type'


def changed(text: str, block: str, pattern: str, by: str) -> str:
    """Return the text with the first match of a pattern after the begin of a block replaced."""
    begin = re.search(block, text)
    assert begin is not None
    rest, count = re.subn(pattern, by, text[begin.start() :], count=1, flags=re.DOTALL)
    assert count == 1
    return text[: begin.start()] + rest


@pytest.mark.parametrize(
    ("block", "pattern", "by", "key", "found"),
    [
        (JOINT, r'rpy="[^"]*"', 'rpy="0 0"', "rpy", "'0 0', expected 3 finite"),
        (JOINT, r'(<origin rpy="[^"]*") xyz="[^"]*"', r'\1 xyz="0 0 abc"', "xyz",
         "'0 0 abc', expected 3 finite"),
        (JOINT, r'<axis xyz="[^"]*"', '<axis xyz="0 0 0"', "axis xyz", "'0 0 0', expected a dir"),
        (JOINT, r"</joint>", '<dynamics friction="nan"/></joint>', "friction",
         "'nan', expected 1 finite"),
        ('<link name="link_3"', r'<mass value="[^"]*"', '<mass value="1 kg"', "value",
         "'1 kg', expected 1 finite"),
        ('<link name="link_3"', r'ixx="[^"]*"', 'ixx="inf"', "ixx", "'inf', expected 1 finite"),
        ('<link name="link_2"', r'xyz="[^"]*"', 'xyz="0 0"', "xyz", "'0 0', expected 3 finite"),
    ],
)  # fmt: skip
def test_numbers_that_cannot_be_used_are_one_line(
    tmp_path: Path, block: str, pattern: str, by: str, key: str, found: str
) -> None:
    cell, model = tmp_path / "cell.yaml", tmp_path / "arm.urdf"
    cell.write_text(CELL)
    model.write_text(changed(urdf(builtin_arm("ur10e"), UR_JOINTS), block, pattern, by))
    line = refused("patch", model, "--cell", cell, "--out", tmp_path / "out.urdf")
    name = re.search(r'name="(\w+)"', block)
    assert name is not None
    assert f"{model}: {block[1:].split()[0]} {name[1]!r}: {key}: found {found}" in line
