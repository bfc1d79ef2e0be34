"""Reading recordings: rows in batches, events, configuration; also of cut and damaged files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto

from gapbridge.core.arrays import Array, Index
from gapbridge.core.errors import LogError
from gapbridge.core.log import mcap_records as records
from gapbridge.core.log.mcap_layout import Layout, layout_in
from gapbridge.core.log.mcap_schema import (
    CONFIGURATION,
    CYCLE_CHANNELS,
    JSON_CHANNELS,
    LOG,
    LOOP,
    MESSAGES,
    STATE,
    message_of,
)
from gapbridge.core.notes import Note, Reason

SUFFIX = ".mcap"
Document = dict[str, Any]


@dataclass(frozen=True)
class Batch:
    """What one chunk of a recording holds, at most some seconds."""

    columns: Mapping[str, Array]  # (k,) or (k, count) by field name
    log_time: Index  # (k,) ns since 1970
    documents: tuple[tuple[str, Document], ...]  # (channel, JSON) in order of writing
    state_names: tuple[str, ...] = ()  # of column "state", from 0 on

    def __len__(self) -> int:
        return len(self.log_time)


def files_of(path: Path) -> list[Path]:
    """Return the files of a recording, in order.

    ``path``: one file, or a run as a whole: the files' name without ``-001.mcap``. Raises LogError
    where there is none.
    """
    if path.is_file():
        return [path]
    pattern = re.compile(rf"{re.escape(path.name)}-(\d{{3,}}){re.escape(SUFFIX)}")
    folder = path.parent
    matches = [pattern.fullmatch(file.name) for file in folder.iterdir()] if folder.is_dir() else []
    parts = sorted((int(match[1]), match[0]) for match in matches if match)
    if not parts:
        what = "found a folder" if path.is_dir() else "file not found"
        raise LogError(f"{path}: {what}, expected a recording of the daemon (MCAP)")
    return [folder / name for _, name in parts]


def read_batches(path: Path) -> Iterator[Batch]:
    """Yield what a recording holds, chunk by chunk; see ``files_of``.

    Leaves out what is damaged (``damages``). Raises LogError where it is no recording.
    """
    for file in files_of(path):
        yield from _read_file(file)


def damages(path: Path) -> tuple[Note, ...]:
    """Return a note for each stretch of a recording that cannot be read; see ``files_of``."""
    return tuple(
        Note(Reason.DAMAGED, (file.name, *stretch))
        for file in files_of(path)
        for stretch in records.damages(file)
    )


def read_configuration(path: Path) -> Document:
    """Return the first configuration of a recording. Raises LogError where it has none."""
    for batch in read_batches(path):
        for topic, document in batch.documents:
            if topic == CONFIGURATION:
                return document
    raise LogError(f"{path}: found no configuration, expected one at the beginning of a recording")


def read_columns(path: Path) -> dict[str, Array]:
    """Return all cycles of a recording by field name, empty where there are none."""
    batches = [batch.columns for batch in read_batches(path) if len(batch)]
    names = list(batches[0]) if batches else []
    return {name: np.concatenate([columns[name] for columns in batches]) for name in names}


def last_batch(path: Path) -> Batch | None:
    """Return the last batch of one file that holds cycles, without reading the whole file."""
    with path.open("rb") as file:
        decoder = _Decoder(path)
        decoder.take(records.definitions(file))
        chunks = list(records.chunk_offsets(file, path))
        if chunks:  # of a file that was not finished, schemas and channels stand in the first one
            decoder.take(records.read_chunk(file, *chunks[0]))
        for offset, length in reversed(chunks):
            contents = records.read_chunk(file, offset, length)
            batch = None if contents is None else decoder.take(contents)
            if batch is not None and len(batch):
                return batch
    return None


def _read_file(path: Path) -> Iterator[Batch]:
    with path.open("rb") as file:
        decoder = _Decoder(path)
        decoder.take(records.definitions(file))  # its first chunk, which has them, may be damaged
        for offset, length in records.chunk_offsets(file, path):
            batch = decoder.take(records.read_chunk(file, offset, length))
            if batch is not None:
                yield batch


@dataclass
class _Decoder:
    """Knows the channels of one file and makes batches of its chunks."""

    path: Path
    schemas: dict[int, bytes] = field(default_factory=dict)
    topics: dict[int, str] = field(default_factory=dict)
    messages: dict[str, DescriptorProto] = field(default_factory=dict)
    layouts: dict[str, Layout] = field(default_factory=dict)
    state_names: tuple[str, ...] = ()

    def take(self, contents: records.Contents | None) -> Batch | None:
        """Return the batch of a chunk; raises LogError where it is no recording's."""
        if contents is None:
            return None
        try:
            self._learn(contents)
            return self._batch(contents)
        except ValueError as error:
            raise LogError(f"{self.path}: {error}, expected a recording of the daemon") from None

    def _learn(self, contents: records.Contents) -> None:
        self.schemas.update((schema.id, schema.data) for schema in contents.schemas)
        for channel in contents.channels:
            self.topics[channel.id] = channel.topic
            if channel.topic not in CYCLE_CHANNELS:
                continue
            if channel.message_encoding != "protobuf":
                raise ValueError(f"found channel {channel.topic} as {channel.message_encoding!r}")
            message = message_of(self.schemas.get(channel.schema_id, b""))
            if message.name != MESSAGES[channel.topic]:
                raise ValueError(f"found channel {channel.topic} to hold {message.name}")
            self.messages[channel.topic] = message
            if channel.topic == LOOP and message.enum_type:
                self.state_names = tuple(value.name for value in message.enum_type[0].value)

    def _batch(self, contents: records.Contents) -> Batch:
        cycles: dict[str, list[bytes]] = {topic: [] for topic in CYCLE_CHANNELS}
        documents: list[tuple[str, Document]] = []
        times: list[int] = []
        for message in contents.messages:
            topic = self.topics.get(message.channel, "")
            if topic in cycles:
                cycles[topic].append(message.data)
                if topic == STATE:
                    times.append(message.log_time)
            elif topic in JSON_CHANNELS and topic != LOG:
                documents.append((topic, json.loads(message.data)))
        columns: dict[str, Array] = {}
        for topic, data in cycles.items():
            if len(data) != len(times):
                raise ValueError(f"found {len(data)} messages on {topic}, {len(times)} on {STATE}")
            if data:
                columns.update(self._decode(topic, data))
        return Batch(columns, np.array(times, np.int64), tuple(documents), self.state_names)

    def _decode(self, topic: str, data: list[bytes]) -> dict[str, Array]:
        layout = self.layouts.get(topic)
        if layout is None:
            layout = self.layouts[topic] = layout_in(self.messages[topic], data[0])
        width = len(layout.template)
        joined = np.frombuffer(b"".join(data), np.uint8)
        if len(joined) != width * len(data):
            raise ValueError(f"found messages on {topic} of several lengths")
        return layout.decode(joined.reshape(-1, width))
