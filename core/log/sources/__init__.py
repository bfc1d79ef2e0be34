"""Recordings in other formats, read as logs: one class a format, and the table of them."""

from __future__ import annotations

from pathlib import Path

from gapbridge.core.log.sources.lerobot import LeRobot
from gapbridge.core.log.sources.recording import Recording
from gapbridge.core.log.sources.ros_bag import RosBag
from gapbridge.core.log.sources.source import Converted, Source, SourceOptions
from gapbridge.core.log.sources.text_recording import Libfranka, UrRecorder

SOURCES: tuple[Source, ...] = (RosBag(), LeRobot(), Libfranka(), UrRecorder(), Recording())


def source_of(path: Path) -> Source | None:
    """Return the kind of source that a path is, None where it is a log (or nothing known)."""
    return next((source for source in SOURCES if source.holds(path)), None)


__all__ = ["SOURCES", "Converted", "Source", "SourceOptions", "source_of"]
