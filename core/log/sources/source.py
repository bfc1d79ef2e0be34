"""The base of other recording formats: one file or folder, read as the columns of a log."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import COLUMNS, as_table
from gapbridge.core.log.log import Log
from gapbridge.core.notes import Note


@dataclass(frozen=True)
class SourceOptions:
    """What a source cannot say of itself, so that the user has to."""

    joints: tuple[str, ...] = ()  # the source's joint names, in the order of the arm's joints
    topics: Mapping[str, str] = field(default_factory=dict)  # role (joints, pose, ...) -> topic
    wrench: str = ""  # column that a wrench topic is: ft_raw_wrench or actual_TCP_force
    effort_is_torque: bool = False  # JointState.effort is Nm (some drivers report A)
    calibration: Path | None = None  # LeRobot's calibration file of the arm
    units: str = ""  # LeRobot: degrees or rad, where there is no calibration file
    episode: int | None = None  # LeRobot: one episode, from 0


@dataclass(frozen=True)
class Converted:
    """A source as a log: arrays (N,) or (N, k) by column name, and what the source cannot say."""

    columns: Mapping[str, Array]
    joints: tuple[str, ...]  # the source's names, in the order of the columns' indices
    notes: tuple[Note, ...] = ()

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def table(self) -> tuple[list[str], Array]:
        """Return names and values (N, k) of the log's columns, indices written out."""
        return as_table({name: self.columns[name] for name in COLUMNS if name in self.columns})

    def log(self, path: Path, n: int) -> Log:
        """Return the log of an arm of n joints. Raises LogError where the source has not n."""
        if len(self.joints) != n:
            raise LogError(
                f"{path}: found {len(self.joints)} joints ({', '.join(self.joints)}), "
                f"expected {n} as the cell's arm has"
            )
        return Log(str(path), dict(self.columns), n)


class Source(ABC):
    """One kind of file or folder that can be read as a log."""

    identifier: ClassVar[str]
    title: ClassVar[str]
    options: ClassVar[tuple[str, ...]] = ()  # the fields of SourceOptions that it reads

    @abstractmethod
    def holds(self, path: Path) -> bool:
        """Return whether the path is of this kind; a cheap look that never raises."""

    @abstractmethod
    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log in it, joints ordered by name.

        ``arm_joints``: the names of the arm's joints, () where there is no cell. Raises LogError
        where the source cannot be read or does not say which joint is which.
        """
