"""The compiled register map: blocks to read, how often, and registers that may be written."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gapbridge.drivers.modbus.profile import MAILBOX_WORDS, Keys, Span, spans
from gapbridge.drivers.modbus.registers import MOST_REGISTERS, Table
from gapbridge.drivers.modbus.schema import ProfileFile


@dataclass(frozen=True, slots=True)
class Block:
    """Registers (or bits) that one request reads."""

    table: Table
    first: int
    count: int

    def holds(self, table: Table, address: int, words: int) -> bool:
        """Return whether registers lie inside."""
        inside = self.first <= address and address + words <= self.first + self.count
        return table == self.table and inside


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """The blocks and writable registers of a profile.

    fast: blocks read in every cycle, the one with the joints first; if the map allows it, only one.
    slow: blocks of conditions, read less often. identity: read once. writable: the only table and
    address pairs that a request may write.
    """

    fast: tuple[Block, ...]
    slow: tuple[Block, ...]
    identity: tuple[Block, ...]
    writable: frozenset[tuple[Table, int]]

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Return the blocks of one sample, in order."""
        return self.fast + self.slow

    def place_of(self, table: Table, address: int, words: int) -> tuple[int, int]:
        """Return which of ``blocks`` holds registers of a sample, and where they begin in it."""
        return place_in(self.blocks, table, address, words)


def place_in(blocks: Iterable[Block], table: Table, address: int, words: int) -> tuple[int, int]:
    """Return which of the blocks holds registers, and where they begin in it."""
    return next(
        (i, address - block.first)
        for i, block in enumerate(blocks)
        if block.holds(table, address, words)
    )


def compile_map(profile: ProfileFile) -> RegisterMap:
    """Return the blocks and the allow-list of a profile."""
    groups: dict[Keys, list[Span]] = {}
    for span in spans(profile):
        groups.setdefault(_group(span.keys), []).append(span)
    every: list[list[Span]] = [groups[("state", "position")]]
    every += [g for k, g in groups.items() if _each_cycle(k) and k != ("state", "position")]
    conditions = [g for k, g in groups.items() if k[0] == "status"]
    identity = [g for k, g in groups.items() if k[0] == "identity"]
    fast = _blocks(every, profile.gaps)
    # conditions that fit into a block that is read in every cycle are read with it
    if profile.gaps:
        fast, conditions = _joined(fast, conditions)
    conditions = [g for g in conditions if not any(_inside(b, g) for b in fast)]
    return RegisterMap(
        tuple(fast),
        tuple(_blocks(conditions, profile.gaps)),
        tuple(_blocks(identity, profile.gaps)),
        frozenset(_writable(profile)),
    )


def _group(keys: Keys) -> Keys:
    """Return the key of a group: angles with their turns, a clock with its repetition."""
    return keys[:1] if keys[0] == "clock" else keys[:2] if keys[0] == "state" else keys


def _each_cycle(keys: Keys) -> bool:
    return keys[0] in ("state", "clock") or (
        keys[0] == "write" and keys[1] in ("echo_address", "busy", "result")
    )


def _blocks(groups: Iterable[list[Span]], gaps: bool) -> list[Block]:
    """Return the fewest blocks that hold the groups, greedily and in their order."""
    remaining = list(groups)
    blocks: list[Block] = []
    while remaining:
        first, *others = remaining
        table = first[0].table
        group_spans, remaining = list(first), []
        for group in others:
            both = [*group_spans, *group]
            if group[0].table == table and _length(both) <= MOST_REGISTERS:
                group_spans = both
            else:
                remaining.append(group)
        blocks.extend(_cut(group_spans, gaps))
    return blocks


def _cut(group: list[Span], gaps: bool) -> list[Block]:
    """Return one block, or, where gaps cannot be read across, one for each unbroken run."""
    entries: dict[Keys, tuple[int, int]] = {}  # each whole: a vector is never cut
    for span in group:
        first, end = entries.get(span.keys, (span.first, span.end))
        entries[span.keys] = (min(first, span.first), max(end, span.end))
    runs: list[tuple[int, int]] = []
    for first, end in sorted(entries.values()):
        if runs and (gaps or first <= runs[-1][1]) and _fits(runs[-1][0], end):
            runs[-1] = (runs[-1][0], max(runs[-1][1], end))
        else:
            runs.append((first, end))
    main = min(s.first for s in group if s.keys == group[0].keys)
    blocks = [Block(group[0].table, first, end - first) for first, end in runs]
    return sorted(blocks, key=lambda b: not b.first <= main < b.first + b.count)


def _fits(first: int, end: int) -> bool:
    return end - first <= MOST_REGISTERS


def _length(group: list[Span]) -> int:
    return max(s.end for s in group) - min(s.first for s in group)


def _joined(
    fast: list[Block], conditions: list[list[Span]]
) -> tuple[list[Block], list[list[Span]]]:
    """Return blocks widened by the conditions that one request still reaches, and the others."""
    separate: list[list[Span]] = []
    for group in conditions:
        for i, block in enumerate(fast):
            first = min(block.first, *(s.first for s in group))
            end = max(block.first + block.count, *(s.end for s in group))
            if group[0].table == block.table and _fits(first, end):
                fast[i] = Block(block.table, first, end - first)
                break
        else:
            separate.append(group)
    return fast, separate


def _inside(block: Block, group: list[Span]) -> bool:
    return all(block.holds(s.table, s.first, s.count) for s in group)


def _writable(profile: ProfileFile) -> set[tuple[Table, int]]:
    write = profile.write
    if write.mode == "read_only":
        return set()
    if write.mode == "mailbox":
        return {(write.table, write.address + i) for i in range(MAILBOX_WORDS)}
    registers: set[tuple[Table, int]] = set()
    for span in spans(profile):
        if span.keys[0] == "write" and span.keys[1] not in ("busy", "result"):
            registers |= {(span.table, span.first + i) for i in range(span.count)}
    return registers
