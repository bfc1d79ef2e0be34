"""A new installation, its machine code apart: after the warm-up nothing compiles."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_cli import CELL, SOFT, measured_log

from gapbridge.bridge.cell import load_cell

COMMANDS = (
    "fit log.csv --cell rigid.yaml --out new.yaml",
    "predict log.csv --cell soft.yaml --channels --out predicted.csv",
    "compensate log.csv --cell soft.yaml --out corrected.csv",
    "diagnose log.csv --cell rigid.yaml",
    "blind --seeds 1 --kinds clean,known --command {diagnose}",  # logs of every channel
)
DIAGNOSE = """
import sys
from gapbridge.bridge.cli import main
sys.stderr = open({said!r}, "a", buffering=1)
main(["diagnose", *sys.argv[1:]])
"""


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_no_command_compiles_after_the_warm_up(tmp_path: Path) -> None:
    own = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "code")}

    def said(*module: str) -> str:
        ran = subprocess.run(
            [sys.executable, "-m", *module], env=own, cwd=tmp_path, capture_output=True, text=True
        )
        assert ran.returncode in (0, 1), ran.stderr
        return ran.stderr

    for name, text in (("rigid", CELL), ("soft", SOFT)):
        (tmp_path / f"{name}.yaml").write_text(text, encoding="utf-8")
    model = load_cell(tmp_path / "soft.yaml").model
    (tmp_path / "log.csv").write_text(measured_log(model, 60), encoding="utf-8")
    diagnose, inner = tmp_path / "diagnose.py", tmp_path / "said.txt"
    diagnose.write_text(DIAGNOSE.format(said=str(inner)), encoding="utf-8")
    said("gapbridge.bridge.loop.warm_up")
    for command in COMMANDS:
        words = [w.format(diagnose=f"{sys.executable} {diagnose}") for w in command.split()]
        assert "compiling" not in said("gapbridge", *words), command
    assert "compiling" not in inner.read_text()
