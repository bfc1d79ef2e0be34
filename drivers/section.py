"""The base class of mappings in users' files: a cell's sections, a driver's profile."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]


class Section(BaseModel):
    """One mapping: unknown keys are refused, and instances are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    def located(self, folder: Path) -> Self:
        """Return it with all paths in it, which are relative to ``folder``, made absolute."""
        placed: dict[str, object] = {}
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, Path):
                placed[name] = folder / value
            elif isinstance(value, Section):
                placed[name] = value.located(folder)
        return self.model_copy(update=placed)
