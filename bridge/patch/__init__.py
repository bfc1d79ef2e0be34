"""Write a cell's effects into simulator models: MJCF, URDF and USD."""

from __future__ import annotations

from pathlib import Path

from gapbridge.bridge.patch.changes import ModelChanges, changes_of
from gapbridge.bridge.patch.mjcf import Mjcf
from gapbridge.bridge.patch.model_format import ModelFormat, Patched, PatchOptions
from gapbridge.bridge.patch.urdf import Urdf
from gapbridge.bridge.patch.usd import Usd
from gapbridge.core.errors import InputError

FORMATS: tuple[ModelFormat, ...] = (Mjcf(), Urdf(), Usd())


def format_of(path: Path) -> ModelFormat:
    """Return the format of a model by its suffix. Raises InputError naming those known."""
    for model_format in FORMATS:
        if path.suffix.lower() in model_format.suffixes:
            return model_format
    known = ", ".join(suffix for model_format in FORMATS for suffix in model_format.suffixes)
    raise InputError(f"{path}: found {path.suffix or 'no suffix'}, expected one of {known}")


__all__ = ["ModelChanges", "ModelFormat", "PatchOptions", "Patched", "changes_of", "format_of"]
