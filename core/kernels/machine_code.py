"""Machine code is kept only while every compiled source is as it was.

Numba keeps what it compiled beside the sources. Before it takes that again it looks whether the
function's own file has changed, not whether another has whose functions were compiled into it
(numba issue 1833). The correction of a setpoint has the statics in it, and those the placing of
frames: after an update of the one, the other would go on as before, and say nothing.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from numba import config
from numba.core import caching, dispatcher, event
from numba.core.runtime.nrt import rtsys

from gapbridge.core.kernels import compiling

CORE = Path(__file__).resolve().parents[1]
FOLDERS = (CORE, CORE / "kernels")  # where compiled functions are that others have inside them
OURS = tuple(CORE.parent / name for name in ("core", "drivers", "bridge"))
MARK = b"njit"
USUAL = ("UserProvided", "InTree", "UserWide", "IPython", "Zip")


@cache
def fingerprint() -> bytes:
    """Return a hash of all sources with compiled functions that others may have inside them."""
    found = hashlib.sha256()
    for file, source in _compiled():
        found.update(b"%s %d " % (file.name.encode(), len(source)) + source)
    return found.digest()


@cache
def names() -> str:
    """Return a short hash of the compiled modules' names, for the names of their machine code.

    Numba's index of a function is pickled with the classes of its arguments: an index that was
    written before a module was renamed cannot even be read.
    """
    found = " ".join(file.relative_to(CORE).as_posix() for file, _ in _compiled())
    return hashlib.sha256(found.encode()).hexdigest()[:8]


@cache
def _compiled() -> list[tuple[Path, bytes]]:
    files = sorted(file for folder in FOLDERS for file in folder.glob("*.py"))
    sources = [(file, file.read_bytes()) for file in files]
    return [(file, source) for file, source in sources if MARK in source]


@cache
def _is_ours(file: str) -> bool:
    return any(folder in Path(file).resolve().parents for folder in OURS)


_WRITABLE: set[str] = set()  # folders in which a file could be made


class _OfAllSources:
    """Finds a place for machine code of our functions, and none for anybody else's."""

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        if not _is_ours(py_file):
            return None
        return super().from_function(py_func, py_file)  # type: ignore[misc]

    def ensure_cache_path(self) -> None:
        """Try once for each folder, not for each function, whether files can be made in it."""
        path = self.get_cache_path()  # type: ignore[attr-defined]
        if path not in _WRITABLE:
            super().ensure_cache_path()  # type: ignore[misc]
            _WRITABLE.add(path)

    def get_source_stamp(self) -> tuple[Any, bytes]:
        return super().get_source_stamp(), fingerprint()  # type: ignore[misc]

    def get_disambiguator(self) -> str:
        return f"{super().get_disambiguator()}-{names()}"  # type: ignore[misc]


class UserProvided(_OfAllSources, caching.UserProvidedCacheLocator):
    """In the folder that NUMBA_CACHE_DIR names."""


class InTree(_OfAllSources, caching.InTreeCacheLocator):
    """Beside the source."""


class UserWide(_OfAllSources, caching.UserWideCacheLocator):
    """In the user's own cache, where the sources' folder cannot be written to."""


class Kept(caching.FunctionCache):
    """The machine code of one function, kept from process to process."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code for a signature, or None where there is none.

        Numba first makes itself ready to compile (and imports scipy.linalg for that): 0.3 s in
        each process. What is only loaded needs the functions that count references alone; what
        then has to be compiled makes itself ready by itself.
        """
        if not isinstance(self._impl.locator, _OfAllSources):
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


class _Compiling(event.Listener):
    """Hears of each function that numba compiles rather than loads."""

    def on_start(self, event: Any) -> None:
        """Inform whoever waits for it."""
        compiling.begin()

    def on_end(self, event: Any) -> None:
        """Do nothing: the next begins at once."""


def keep_by_all_sources() -> None:
    """Have numba ask for all compiled sources from now on; before the first compiled function.

    From then on ``compiling.listeners`` hear of what is compiled.
    """
    settings: Any = config  # its values are made when it is imported
    ours = [f"{__name__}.{one.__name__}" for one in (UserProvided, InTree, UserWide)]
    if ours[0] in settings.CACHE_LOCATOR_CLASSES:
        return
    event.register("numba:compile", _Compiling())  # type: ignore[no-untyped-call]
    kept: Any = dispatcher
    kept.FunctionCache = Kept
    names = [f"{name}CacheLocator" for name in USUAL]
    others = settings.CACHE_LOCATOR_CLASSES or ",".join(
        f"{caching.__name__}.{name}" for name in names if hasattr(caching, name)
    )
    settings.CACHE_LOCATOR_CLASSES = ",".join([*ours, others])
