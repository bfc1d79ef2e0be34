"""Makes the truth makers beside the tests importable, from the folders below too."""

import sys
from pathlib import Path

# the oracles (tests/oracle) and the benchmarks are no part of what is installed
for folder in (Path(__file__).parents[1], Path(__file__).parents[2]):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
