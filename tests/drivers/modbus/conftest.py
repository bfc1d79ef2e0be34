"""The contract's cases serve here too."""

import sys
from pathlib import Path

CONTRACT = Path(__file__).parents[1] / "contract"
if str(CONTRACT) not in sys.path:
    sys.path.insert(0, str(CONTRACT))
