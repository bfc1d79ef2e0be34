"""A copy of the checkout in which one mistake after the other is made and its tests are run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.mutants.mutant import Mutant

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 600.0  # s for the tests of one mutant; one that hangs them is noticed
COPIED = ("benchmarks", "bridge", "config", "core", "docs", "drivers", "gapbridge", "tests")
MARKERS = "not slow"  # of make test
PASSED, FAILED = 0, 1  # pytest's exit codes


@dataclass(frozen=True)
class Verdict:
    """What came of one mutant."""

    mutant: Mutant
    killed: bool
    detail: str  # the first test that failed, or why there is none


class Trial:
    """The copy. Compiled code is taken along: only what a mistake touches is compiled anew.

    Only tests that ``make test`` runs count: slow ones would notice a mistake too late.
    """

    def __init__(self, folder: Path) -> None:
        self.root = folder / "checkout"
        self._pass: set[tuple[str, ...]] = set()  # tests that pass without any mistake
        self.root.mkdir(parents=True)
        for name in COPIED:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, self.root / name, symlinks=True)
        for path in ROOT.iterdir():
            if path.is_file():
                shutil.copy2(path, self.root / path.name)

    def try_tests(self, tests: tuple[str, ...]) -> tuple[int, str]:
        """Run tests in the copy; returns pytest's exit code and the first failure, or its end."""
        command = [
            sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider",
            "-o", "addopts=--strict-markers --timeout=300 --tb=line", "-m", MARKERS, *tests,
        ]  # fmt: skip
        environment = {**os.environ, "PYTHONPATH": str(self.root)}
        try:
            done = subprocess.run(
                command, cwd=self.root, env=environment, capture_output=True, text=True,
                timeout=LIMIT, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return FAILED, f"no end within {LIMIT:g} s"
        lines = done.stdout.strip().splitlines() or done.stderr.strip().splitlines() or [""]
        failures = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
        return done.returncode, (failures or lines[-1:])[0]

    def judge(self, mutant: Mutant) -> Verdict:
        """Make one mistake, run its tests, and take it back."""
        path = self.root / mutant.file
        before, times = path.read_bytes(), path.stat()
        path.write_text(mutant.text(self.root), encoding="utf-8")
        try:
            code, detail = self.try_tests(mutant.tests)
        finally:
            path.write_bytes(before)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
        if code not in (PASSED, FAILED):
            detail = f"pytest ended with {code}: {detail}"
        elif code == FAILED and (failure := self._failure(mutant.tests)):
            return Verdict(mutant, False, f"its tests fail without it too: {failure}")
        return Verdict(mutant, code == FAILED, detail)

    def _failure(self, tests: tuple[str, ...]) -> str:
        """Return what fails in the copy as it is; empty where the tests pass."""
        if tests in self._pass:
            return ""
        code, detail = self.try_tests(tests)
        if code == PASSED:
            self._pass.add(tests)
            return ""
        return detail
