"""CANopen profiles for tests whose subject is not a heartbeat that comes late."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from gapbridge.drivers.canopen.settings import CanopenSettings

PATIENT = {"lost_after": 3.0, "drives_wait": 2.5}  # s without a heartbeat, of a busy machine


def patient(profile: str, folder: Path) -> str:
    """Return the path of a copy of a shipped profile that waits longer for heartbeats."""
    shipped = CanopenSettings.shipped
    text = (shipped / f"{profile}.yaml").read_text(encoding="utf-8")
    for key, seconds in PATIENT.items():
        text, found = re.subn(rf"^  {key}: .*", f"  {key}: {seconds}", text, flags=re.MULTILINE)
        assert found == 1, key
    shutil.copy(shipped / "cia402.eds", folder)
    path = folder / f"{profile}.yaml"
    path.write_text(text, encoding="utf-8")
    return str(path)
