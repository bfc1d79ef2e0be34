"""A million frames into each decoder: nothing escapes, nothing torn or broken is taken for good."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU

from gapbridge.drivers.ft_sensor.ati_netcanoem import AnswerDecoder, decode_gauges
from gapbridge.drivers.ft_sensor.robotiq_ft300 import FRAME, HEAD, StreamDecoder
from gapbridge.drivers.ft_sensor.robotous_rft import LAYOUT, START, PairDecoder

MILLION = 1_000_000
PERIOD, APART = 0.005, 0.0003  # s between samples, between the frames of one


def sample_of(k: int) -> tuple[int, ...]:
    """Return six counts that identify which sample they are of, each of them."""
    k &= 0x7FFF
    return (k, -k, k ^ 0x2AAA, k, -k, k ^ 0x1555)


def halves(k: int) -> tuple[bytes, bytes]:
    whole = LAYOUT.pack(START, *sample_of(k), k & 0x7F)
    return whole[:8], whole[8:]


def test_pair_decoder_of_the_robotous_never_pairs_what_is_apart() -> None:
    pair_frames(20_000)


@pytest.mark.slow
def test_a_million_frames_of_a_robotous_make_no_torn_sample() -> None:
    pair_frames(MILLION)


def pair_frames(frames: int) -> None:
    """Lose, double, cut and forge frames; every sample that comes out is one that went in."""
    rng = np.random.default_rng(1)
    decoder = PairDecoder((1, 2), 0.5 * PERIOD)
    fates = rng.integers(0, 12, frames)
    lengths, junk = rng.integers(0, 8, frames), rng.bytes(8 * 1024)
    good = 0
    for i in range(0, frames, 2):
        k = i // 2
        for half, data in enumerate(halves(k)):
            fate, length = fates[i + half], int(lengths[i + half])
            stamp, identifier = k * PERIOD + half * APART, 1 + half
            if fate == 0:
                continue  # lost
            if fate == 1:
                data = data[:length]
            elif fate == 2:
                identifier = 3 + length
            elif fate == 3:  # another speaks in between, under an id of ours
                found = decoder.take(2 - half, junk[8 * length : 8 * length + length], stamp)
                assert found is None
            elif fate == 4 and half == 0:
                data = bytes([START ^ (1 << length % 7 + 1)]) + data[1:]
            found = decoder.take(identifier, data, stamp)
            if fate == 5 and found is None:
                found = decoder.take(identifier, data, stamp)
            if found is not None:
                good += 1
                assert found == (*sample_of(k), k & 0x7F)
    assert 0.3 * frames / 2 < good < 0.9 * frames / 2
    assert decoder.dropped > 0


def test_answer_decoder_of_the_ati_never_mixes_answers() -> None:
    answers(20_000)


@pytest.mark.slow
def test_a_million_frames_of_an_ati_make_no_torn_sample() -> None:
    answers(MILLION)


def answers(frames: int) -> None:
    """One decoder for the whole stream, which is harder than one for each question."""
    rng = np.random.default_rng(2)
    decoder = AnswerDecoder(0x200, 2, 0.5 * PERIOD)
    fates, lengths = rng.integers(0, 10, frames), rng.integers(0, 9, frames)
    junk = rng.bytes(64)
    good = 0
    for i in range(0, frames, 2):
        k, (a, b, c, d, e, f) = i // 2, sample_of(i // 2)
        status = k & 0x3FFF
        for half, phrase in enumerate(((status, a & 0xFFFF, c & 0xFFFF, e & 0xFFFF),
                                      (b & 0xFFFF, d & 0xFFFF, f & 0xFFFF))):  # fmt: skip
            fate, length = fates[i + half], int(lengths[i + half])
            data = b"".join(w.to_bytes(2, "big") for w in phrase)
            identifier, stamp = 0x200 + half, k * PERIOD + half * APART
            if fate == 0:
                continue
            if fate == 1:
                data = junk[:length] if length != (8, 6)[half] else b""
            elif fate == 2:
                identifier = 0x200 + 2 + length
            found = decoder.take(identifier, data, stamp)
            decoded = None if found is None else decode_gauges(*found)
            if decoded is not None:
                good += 1
                assert (decoded[0] & 0xFFFF, decoded[1]) == (status, (a, b, c, d, e, f))
    assert 0.3 * frames / 2 < good < 0.9 * frames / 2


@given(st.binary(max_size=12), st.binary(max_size=12))
def test_gauges_of_any_bytes_are_int16_or_nothing(first: bytes, second: bytes) -> None:
    found = decode_gauges(first, second)
    assert (found is not None) == (len(first) == 8 and len(second) == 6)
    assert found is None or all(-32768 <= v <= 32767 for v in found[1])


def stream_frame(k: int) -> bytes:
    body = HEAD + FRAME.pack(*sample_of(k))[2:-2]
    return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")


def test_stream_decoder_of_the_ft300_takes_whole_frames_only() -> None:
    stream(20_000, bursts_only=True)
    stream(20_000, bursts_only=False)


@pytest.mark.slow
def test_a_million_frames_of_an_ft300_with_bursts_of_errors_make_no_wrong_sample() -> None:
    stream(MILLION // 2, bursts_only=True)
    stream(MILLION // 2, bursts_only=False)


def stream(frames: int, bursts_only: bool) -> None:
    """Break frames; a burst of up to 16 bits never passes, other damage as CRC-16 lets it pass."""
    rng = np.random.default_rng(3)
    decoder = StreamDecoder()
    fates, places = rng.integers(0, 8, frames), rng.integers(2, 14, frames)
    bursts, junk = rng.integers(1, 1 << 16, frames), rng.bytes(4096)
    cuts = rng.integers(1, 200, frames)
    pending, begun, good, wrong, expected = bytearray(), 0, 0, 0, 0
    for k in range(frames):
        frame, place = stream_frame(k), int(places[k])
        if fates[k] == 0:
            damage = int(bursts[k]).to_bytes(2, "big")
            middle = bytes(x ^ y for x, y in zip(frame[place : place + 2], damage, strict=True))
            frame = frame[:place] + middle + frame[place + 2 :]
        elif not bursts_only and fates[k] == 1:
            frame = frame[:place] + frame[place + 1 :]  # a byte lost
        elif not bursts_only and fates[k] == 2:
            frame = frame[:place] + junk[place : 3 * place] + frame[place:]
        elif not bursts_only and fates[k] == 3:
            frame = junk[k % 4000 : k % 4000 + place]
        else:
            expected += 1
        pending += frame
        if len(pending) >= cuts[k] or k == frames - 1:
            for counts in decoder.take(bytes(pending)):
                fine = counts == sample_of(counts[0]) and begun <= k
                good, wrong = good + fine, wrong + (not fine)
            pending.clear()
    assert decoder.dropped > 0
    if bursts_only:
        assert (good, wrong) == (expected, 0)
    else:
        assert wrong <= 3 + 4 * (frames - expected) / 65536
        assert expected * 0.98 <= good <= frames


@given(st.lists(st.binary(max_size=40), max_size=20))
def test_stream_decoder_keeps_little_whatever_comes(pieces: list[bytes]) -> None:
    decoder = StreamDecoder()
    for piece in pieces:
        decoder.take(piece)
        assert len(decoder._bytes) < FRAME.size
