"""The folders that a fleet's results go to."""

from __future__ import annotations

import os
from pathlib import Path

from gapbridge.bridge.document.output_file import FOLDER_MODE
from gapbridge.core.errors import InputError


def require_folder(path: Path, option: str) -> Path:
    """Make the folder with those above it; raises InputError where it cannot be had."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: found a file, expected a folder for {option}")
    try:
        path.mkdir(FOLDER_MODE, parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: folder cannot be made: {error.strerror}") from None
    if not os.access(path, os.W_OK):
        raise InputError(f"{path}: found a folder that cannot be written to, for {option}")
    return path
