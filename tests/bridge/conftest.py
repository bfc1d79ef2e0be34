"""Makes the helpers beside the tests importable, from the folders below too."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
for folder in (HERE, HERE / "calibration", HERE / "recording"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
