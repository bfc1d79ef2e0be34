"""A drive's EDS or DCF: its object dictionary, read with the canopen library."""

from __future__ import annotations

import io
import pickle
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from gapbridge.core.errors import first_line
from gapbridge.core.files import read_text
from gapbridge.drivers.canopen.objects import Address
from gapbridge.drivers.profile_file import ProfileError

SUFFIXES = (".eds", ".dcf")


@dataclass(frozen=True, slots=True)
class Variable:
    """One number of the object dictionary."""

    bits: int
    signed: bool
    readable: bool
    writable: bool
    mappable: bool


@dataclass(frozen=True)
class Eds:
    """One EDS. ``dictionary`` makes a fresh canopen.ObjectDictionary for a node."""

    path: Path
    _objects: Any = field(compare=False, repr=False)  # the dictionary of one node, as it was read

    def dictionary(self, node: int) -> Any:
        """Return the object dictionary of one node; raises ProfileError."""
        return _import(self.path, node)

    def variable(self, address: Address) -> Variable | None:
        """Return the variable at an address, None if the EDS has no number there."""
        import canopen.objectdictionary as library

        entry = _entry(self._objects, address)
        if entry is None or entry.data_type not in library.INTEGER_TYPES:
            return None
        signed = entry.data_type in library.SIGNED_TYPES
        return Variable(len(entry), signed, entry.readable, entry.writable, entry.pdo_mappable)

    def has(self, address: Address) -> bool:
        """Return whether the EDS has an object at an address."""
        return _entry(self._objects, address) is not None


def read_eds(path: Path, node: int) -> Eds:
    """Return an EDS of a drive. Raises ProfileError with a reason in one line."""
    if path.suffix.lower() not in SUFFIXES:
        raise ProfileError(f"found {path.name}, expected a file ending in {' or '.join(SUFFIXES)}")
    objects = _import(path, node)
    if 0x6041 not in objects:
        raise ProfileError(f"{path}: found no Statusword (0x6041), expected the EDS of a drive")
    return Eds(path, objects)


def _import(path: Path, node: int) -> Any:
    try:
        return pickle.loads(_imported(str(path), read_text(path), node))
    except FileNotFoundError:
        raise ProfileError(f"{path}: file not found, expected an EDS") from None
    except OSError as error:
        raise ProfileError(f"{path}: cannot be read: {first_line(error)}") from None
    except Exception as error:  # configparser's, ValueError, KeyError: whatever a broken EDS brings
        raise ProfileError(f"{path}: found a broken EDS: {first_line(error)}") from None


@lru_cache(maxsize=32)
def _imported(name: str, text: str, node: int) -> bytes:
    """Return a node's dictionary, pickled: twenty times as quick as parsing, when reconnecting."""
    import canopen

    source = io.StringIO(text)
    source.name = name  # the library takes the kind of file from it
    return pickle.dumps(canopen.import_od(source, node))


def _entry(dictionary: Any, address: Address) -> Any:
    import canopen.objectdictionary as library

    if address.index not in dictionary:
        return None
    entry = dictionary[address.index]
    if isinstance(entry, library.ODVariable):
        return entry if address.subindex == 0 else None
    return entry.get(address.subindex)
