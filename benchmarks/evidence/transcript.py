"""A first session on the simulated UR10e, as the terminal shows it: ``docs/transcript.md``.

    python -m benchmarks.evidence.transcript --out docs/transcript.md

Runs the commands that it prints, one after the other, against ``gapbridge simulate``, and plays the
person beside the arm, who says yes. Takes five minutes or so.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pexpect  # type: ignore[import-untyped]

from gapbridge.bridge.demo.links.link import free_address
from gapbridge.bridge.demo.links.ur_rtde import UrRtdeLink
from gapbridge.bridge.demo.processes import ServedCell

ROOT = Path(__file__).resolve().parents[2]
SEED = 3
PATIENCE = 420.0  # s: many stops pass without a question
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
SECTION = """
calibration:
  instrument: {kind: simulated_tracker}       # a real one: docs/calibration.md
  loads:                                      # kg, m from the flange
    - {name: reflector alone, mass: 1.5, cog: [0.0, 0.0, 0.05]}
    - {name: with the 8 kg plate, mass: 9.5, cog: [0.0, 0.0, 0.09]}
  poses: 16
  repeats: 2
  floor: 0.1
  joint_range:
    lower: [-1.2, -2.4, 0.4, -2.8, -2.4, -1.5]
    upper: [1.2, -0.6, 2.3, -0.6, -0.8, 1.5]
  speed: 1.5                                  # rad/s; 0.4 where nothing is said
  settle: 0.3
"""
ADDED = """What the controller cannot know is added to the cell by hand: that the tracker measures
in base (`registered: true`), and what is calibrated."""
INTRODUCTION = """# A first session, as the terminal shows it

    {command}

writes this page: every line below a `$` is what the command printed, against the simulated UR10e of
`gapbridge simulate` (seed {seed}: flexibilities drawn from it, which nothing below knows). The
person's part, yes and Enter, stands where it was typed.
"""


class Session:
    """Commands in a folder, and what they showed."""

    def __init__(self, folder: Path, host: str) -> None:
        self.folder, self.host = folder, host
        self.shown: list[str] = []
        paths = os.pathsep.join(p for p in (str(ROOT), *sys.path) if p)
        self._environment = {
            **os.environ, "PYTHONPATH": paths, "COLUMNS": "100", "TERM": "dumb",
            "XDG_RUNTIME_DIR": str(folder),
        }  # fmt: skip

    def run(self, arguments: str) -> None:
        """Run a command to its end. Raises SystemExit where it fails."""
        ran = subprocess.run(
            [sys.executable, "-m", "gapbridge", *arguments.split()], cwd=self.folder, text=True,
            env=self._environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
        )  # fmt: skip
        self._show(arguments, ran.stdout)
        if ran.returncode:
            raise SystemExit(f"gapbridge {arguments}: ended with {ran.returncode}\n{ran.stdout}")

    def converse(self, arguments: str) -> None:
        """Run a command that asks questions; each is answered as a person would."""
        child = pexpect.spawn(
            sys.executable, ["-m", "gapbridge", *arguments.split()], cwd=str(self.folder),
            env=self._environment, encoding="utf-8", timeout=PATIENCE, dimensions=(50, 100),
        )  # fmt: skip
        child.delaybeforesend = None
        shown = ""
        while (found := child.expect([r" > ", pexpect.EOF, pexpect.TIMEOUT])) != 1:
            if found:
                child.close(force=True)
                raise SystemExit(f"gapbridge {arguments}: silent for {PATIENCE:g} s\n{shown}")
            new = CONTROL.sub("", child.before)
            shown += f"{new} > "
            question = re.split(r"[\r\n]+", new)[-1]
            if "as soon as it rests" not in question:
                child.send(("yes" if "yes" in question else "") + "\r")
        child.close()
        shown += CONTROL.sub("", child.before or "")
        self._show(arguments, shown)
        if child.exitstatus:
            raise SystemExit(f"gapbridge {arguments}: ended with {child.exitstatus}\n{shown}")

    def _show(self, arguments: str, text: str) -> None:
        lines = [
            line.rsplit("\r", 1)[-1].rstrip() for line in text.replace("\r\n", "\n").split("\n")
        ]
        body = re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip("\n")
        self.shown.append(f"```\n$ gapbridge {arguments}\n{body}\n```")


def transcript() -> str:
    """Return the page."""
    host = free_address(UrRtdeLink.ports)
    with tempfile.TemporaryDirectory(prefix="session-") as name:
        folder = Path(name)
        served = folder / "served.yaml"
        text = (ROOT / "config" / "ur10e_calibration_simulated.yaml").read_text(encoding="utf-8")
        served.write_text(text.replace("127.0.0.2", host), encoding="utf-8")
        session = Session(folder, host)
        with ServedCell(served, SEED):
            session.run(f"init {host} --out cell.yaml")
            cell = folder / "cell.yaml"
            found = cell.read_text(encoding="utf-8").replace(
                "registered: false", "registered: true"
            )
            cell.write_text(found + SECTION, encoding="utf-8")
            session.shown.append(f"{ADDED}\n```yaml{SECTION}```")
            session.run("check cell.yaml --live")
            session.run("run cell.yaml --observe --duration 3")
            session.converse("calibrate cell.yaml --move --session monday --apply calibrated.yaml")
            session.run("diagnose monday/readings.csv --cell calibrated.yaml")
            session.run("diff cell.yaml calibrated.yaml")
            session.run("run calibrated.yaml --arm --duration 3")
        pages = [part.replace(f"{folder}/", "") for part in session.shown]
    command = "python -m benchmarks.evidence.transcript --out docs/transcript.md"
    return "\n\n".join([INTRODUCTION.format(command=command, seed=SEED).rstrip(), *pages]) + "\n"


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "transcript.md")
    out = parser.parse_args().out
    out.write_text(transcript(), encoding="utf-8")
    print(f"{out}: written")


if __name__ == "__main__":
    main()
