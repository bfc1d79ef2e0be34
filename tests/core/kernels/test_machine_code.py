"""Machine code of a function goes when another source changes that was compiled into it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from further import further

from gapbridge.core.kernels import machine_code
from gapbridge.core.kernels.machine_code import CORE, FOLDERS, MARK

KERNEL = """\
from numba import njit
from gapbridge.core.kernels.machine_code import keep_by_all_sources
keep_by_all_sources()
@njit(cache=True)
def statics(x):
    return {factor} * x
"""
CORRECTION = """\
from numba import njit
from gapbridge.core.kernels.reference import statics
@njit(cache=True)
def correct(x):
    return statics(x) + 1.0
print(correct(1.0), sum(correct.stats.cache_hits.values()))
"""


class Package:
    """A small copy of the real one: two compiled files, one within the other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.core = folder / "gapbridge" / "core"
        (self.core / "kernels").mkdir(parents=True)
        (self.core.parent / "__init__.py").write_text("")
        (self.core / "__init__.py").write_text("")
        for name in ("compiling.py", "machine_code.py"):
            shutil.copy(CORE / "kernels" / name, self.core / "kernels")
        (self.core / "correction.py").write_text(CORRECTION)
        self.change(2.0)

    def change(self, factor: float) -> None:
        (self.core / "kernels" / "reference.py").write_text(KERNEL.format(factor=factor))

    def run(self, **environment: str) -> str:
        """Return what a process of its own computes, and how often it took what was compiled.

        Without bytecode: a source that is written twice in a second is taken for unchanged there.
        """
        done = subprocess.run(
            [sys.executable, "-Bc", "import gapbridge.core.correction"], cwd=self.folder, text=True,
            env={**os.environ, "PYTHONPATH": str(self.folder), **environment},
            capture_output=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()


@pytest.fixture
def package(tmp_path: Path) -> Package:
    return Package(tmp_path)


def test_what_was_compiled_in_changes_and_the_caller_is_compiled_anew(package: Package) -> None:
    assert package.run() == "3.0 0"
    assert package.run() == "3.0 1"
    package.change(5.0)
    assert package.run() == "6.0 0"
    assert package.run() == "6.0 1"


@pytest.mark.slow
def test_a_file_without_compiled_functions_costs_nothing(package: Package) -> None:
    package.run()
    (package.core / "words.py").write_text("TEXT = 1\n")
    assert package.run() == "3.0 1"


@pytest.mark.slow
def test_machine_code_from_before_a_module_was_renamed_is_not_read(package: Package) -> None:
    """Numba's index pickles the classes of arguments by the module that they are defined in."""
    kernels = package.core / "kernels"
    arm = "from typing import NamedTuple\nclass Arm(NamedTuple):\n    length: float\n"
    run = CORRECTION.replace("(x)", "(arm)").replace("statics(arm)", "statics(arm.length)")
    run = run.replace("correct(1.0)", "correct(Arm(1.0))")
    reference = (kernels / "reference.py").read_text()
    (kernels / "reference.py").write_text(arm + reference)
    (package.core / "correction.py").write_text(
        "from gapbridge.core.kernels.reference import Arm\n" + run
    )
    assert package.run() == "3.0 0"
    (kernels / "reference.py").unlink()
    (kernels / "renamed.py").write_text(arm + reference)
    text = (package.core / "correction.py").read_text().replace(".reference", ".renamed")
    (package.core / "correction.py").write_text(text)
    assert package.run() == "3.0 0"


@pytest.mark.slow
def test_other_places_for_machine_code_look_at_all_sources_too(
    package: Package, tmp_path: Path
) -> None:
    place = {"NUMBA_CACHE_DIR": str(tmp_path / "elsewhere")}
    assert package.run(**place) == "3.0 0"
    assert not list(package.core.rglob("*.nbi"))
    package.change(5.0)
    assert package.run(**place) == "6.0 0"
    assert package.run(**place) == "6.0 1"


def test_compiled_functions_stand_only_where_they_are_looked_for() -> None:
    here = [file for file in CORE.rglob("*.py") if MARK in file.read_bytes()]
    assert {file.parent for file in here} == set(FOLDERS)


def test_each_compiled_function_of_ours_is_kept_so() -> None:
    from gapbridge.bridge.loop import setpoint_stream
    from gapbridge.core import limits
    from gapbridge.core.kernels import interpolation, single

    compiled = (single.correct, limits._limit, interpolation._follow, setpoint_stream._track)
    for function in compiled:
        stamp = function._cache._impl.locator.get_source_stamp()
        assert stamp[1] == machine_code.fingerprint(), function


def test_functions_of_other_libraries_are_left_alone() -> None:
    assert machine_code.InTree.from_function(Package.run, np.__file__) is None
    assert machine_code.InTree.from_function(Package.run, machine_code.__file__) is not None


@pytest.mark.slow
def test_what_is_loaded_does_not_make_numba_ready_to_compile(package: Package) -> None:
    """Numba would import scipy.linalg for that: 0.3 s in each process."""
    path = package.core / "correction.py"
    path.write_text(path.read_text() + "import sys\nprint('scipy.linalg' in sys.modules)\n")
    assert package.run().split() == ["3.0", "0", "True"]
    assert package.run().split() == ["3.0", "1", "False"]


@pytest.mark.slow
def test_what_is_loaded_compiles_nothing_of_numbas_own(package: Package) -> None:
    """Nor reads bitcode, of our functions or of those that count references."""
    path = package.core / "correction.py"
    heard = """\
from llvmlite import binding
from numba.core.runtime import nrtdynmod
for place, name in ((nrtdynmod, "create_nrt_module"), (binding, "parse_bitcode")):
    def reported(*given, called=getattr(place, name), name=name):
        print(name)
        return called(*given)
    setattr(place, name, reported)
"""
    path.write_text(heard + path.read_text())
    assert "create_nrt_module" in package.run().split()
    assert package.run().split() == ["3.0", "1"]


@pytest.mark.slow
def test_what_was_loaded_goes_into_what_is_compiled_then(package: Package) -> None:
    path = package.core / "correction.py"
    more = "from gapbridge.core.kernels.reference import statics\nprint(statics(2.0))\n"
    path.write_text(more + path.read_text())
    assert package.run().split() == ["4.0", "3.0", "0"]
    path.write_text(path.read_text().replace("+ 1.0", "+ 2.0"))
    assert package.run().split() == ["4.0", "4.0", "0"]  # the one loaded, the other compiled


PREDICTION = """\
import sys
import numpy as np
from gapbridge.core.arm import builtin_arm
from gapbridge.core.model import Model
model = Model(builtin_arm("ur10e")).with_compliance(np.full(6, 1e-5), np.full(6, 1e-5))
model.predict(np.zeros((70, 6)))
print(sorted({name for name in ("scipy.linalg", "numba.np.arraymath", "numba.np.linalg",
              "numba.np.arrayobj") if name in sys.modules}))
"""


@pytest.mark.slow
def test_a_prediction_needs_no_linear_algebra_of_scipy() -> None:
    """Each function of numpy's that a kernel calls may bring what takes long to import.

    An array that a kernel makes is made by compiled code of numba.np.arrayobj.
    """
    for _ in range(2):  # the first may compile
        done = subprocess.run(
            [sys.executable, "-c", PREDICTION], text=True, capture_output=True,
            check=True,
        )  # fmt: skip
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "missing",
    [
        "environment._rebuild_env",
        *further("caching.CodeLibraryCacheImpl", "config.CACHE_LOCATOR_CLASSES"),
    ],
)
def test_another_numba_keeps_no_machine_code_but_computes(missing: str) -> None:
    # what is kept without these parts would not notice that a source has changed
    program = f"""
from numba.core import caching, config, environment
del {missing}
from numba import njit
from gapbridge.core.kernels.reference import JIT
print(JIT["cache"], njit(**JIT)(lambda x: 2 * x)(3))
"""
    done = subprocess.run([sys.executable, "-c", program], text=True, capture_output=True)
    assert done.stdout.split() == ["False", "6"], done.stderr
