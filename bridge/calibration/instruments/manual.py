"""Numbers typed, or pasted from the clipboard, at the terminal."""

from __future__ import annotations

from gapbridge.bridge.calibration.instruments.instrument import Instrument, Samples, Where
from gapbridge.bridge.calibration.instruments.numbers import coordinates, numbers
from gapbridge.bridge.cell.settings.instruments import TypedSettings


class Typed(Instrument[TypedSettings]):
    """A person reads a display and types; several lines pasted at once count one by one."""

    manual = True
    waits = True

    @property
    def name(self) -> str:
        """Return what is typed."""
        return f"readings typed in {self.settings.unit}"

    def read(self, where: Where) -> Samples:
        """Return one sample (1, 3) or (1, 6). Raises ReadingError."""
        given = self.settings
        what = "x y z" if not given.pose else f"x y z and {given.rotation}"
        line = self.around.ask(f"{what}, {given.unit}")
        return Samples(coordinates(numbers(line, given.width, given.unit), given)[None])
