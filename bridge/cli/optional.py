"""Commands whose work lives in a module that an installation may lack."""

from __future__ import annotations

import importlib
from typing import Any

from gapbridge.core.errors import RunError


def member(module: str, name: str, command: str) -> Any:
    """Return ``module.name``, imported now.

    Raises RunError, one line, where this installation has no such module; a module that is there
    but lacks something of its own is not mistaken for that.
    """
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise
        raise RunError(
            f"{command}: found no module {module} in this installation, expected a checkout that "
            "has it"
        ) from None
