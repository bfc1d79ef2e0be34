"""Makes the truth makers beside the tests importable, from the folders below too."""

import sys
from pathlib import Path

# the oracles (tests/oracle) and the benchmarks are no part of what is installed
HERE = Path(__file__).parent
for folder in (HERE.parent, HERE.parents[1], HERE, HERE / "calibration", HERE / "diagnosis"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
