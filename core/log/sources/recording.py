"""Recordings of the Gapbridge daemon."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gapbridge.core.errors import LogError
from gapbridge.core.log.pieces import RECORDING, LogPieces, missing_values, reported_columns
from gapbridge.core.log.sources.source import Converted, Source, SourceOptions


class Recording(Source):
    """One file of a run, or the run as a whole (its name without ``-001.mcap``)."""

    identifier = "recording"
    title = "recording of gapbridge run"

    def holds(self, path: Path) -> bool:
        """Return whether this is one file of a run, or its name."""
        if path.exists():
            return path.is_file() and path.suffix.lower() == RECORDING
        from gapbridge.core.log.mcap_reading import files_of  # brings protobuf: not for every log

        try:
            return bool(files_of(path))
        except LogError:
            return False

    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log; see ``Source.read``."""
        from gapbridge.core.log.mcap_reading import damages, files_of

        n = len(arm_joints) or _joints(path)
        reported = reported_columns(path)
        pieces = [
            piece for file in files_of(path) for piece in LogPieces(file, n, reported=reported)
        ]
        if not pieces:
            raise LogError(
                f"{path}: found no cycles, expected a recording of gapbridge run, or an MCAP file "
                "with ROS 2 messages"
            )
        names = set.intersection(*(set(piece.columns) for piece in pieces)) - {"approach"}
        columns = {name: np.concatenate([p.columns[name] for p in pieces]) for name in names}
        joints = tuple(f"joint_{i + 1}" for i in range(n))
        return Converted(columns, joints, (*damages(path), *missing_values(reported)))


def _joints(path: Path) -> int:
    """Return how many joints the recorded arm has, 0 where nothing was recorded."""
    from gapbridge.core.log.mcap_reading import read_batches

    first = next((batch for batch in read_batches(path) if "actual_q" in batch.columns), None)
    return 0 if first is None else int(first.columns["actual_q"].shape[1])
