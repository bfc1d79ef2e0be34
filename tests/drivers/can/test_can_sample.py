import struct
from pathlib import Path

import numpy as np
import pytest
from can_arm import UNIT, joints_frame
from further import further
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import InvalidStateError
from gapbridge.drivers.can.assembler import Assembler
from gapbridge.drivers.can.loading import read_profile
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.can.state import StateBuilder
from gapbridge.drivers.state_check import SampleCheck

PIPER = read_profile(CanSettings.shipped / "piper.yaml")
PERIOD = 0.005  # s
INVENTED = Path(__file__).with_name("invented.yaml")
# A frame that is later than this cannot be distinguished from one of the next cycle, where those
# between are lost and none carries a count.
LATE = PERIOD - PIPER.window - 1e-4  # s
IDS = (0x2A5, 0x2A6, 0x2A7)


def cycle(k):
    """The three joint frames of cycle k: every joint says k, so that a mixture shows."""
    return [(IDS[i], struct.pack(">ii", 100 * k, 100 * k)) for i in range(3)]


def taken(frames):
    """Feed (id, data, stamp) and return what came out as counts of the wire."""
    assembler, found = Assembler(PIPER), []
    for identifier, data, stamp in frames:
        sample = assembler.take((identifier, False), data, stamp, stamp)
        if sample is not None:
            found.append(np.round(sample.position / UNIT).astype(int).tolist())
    return found, assembler


def test_a_stream_of_whole_samples_comes_through_one_by_one():
    frames = [(i, d, k * PERIOD + n * 1e-4) for k in range(20) for n, (i, d) in enumerate(cycle(k))]
    found, assembler = taken(frames)
    assert found == [[100 * k] * 6 for k in range(20)]
    assert assembler.broken == 0


def test_frames_farther_apart_than_the_window_make_no_sample():
    (a, b, c) = cycle(1)
    found, assembler = taken([(*a, 0.0), (*b, 0.001), (*c, 0.0026)])
    assert found == []
    assert assembler.dropped["torn"] == 1


def test_a_clock_that_goes_back_makes_no_sample():
    (a, b, c) = cycle(1)
    assert taken([(*a, 1.0), (*b, 0.9), (*c, 1.001)])[0] == []


edits = st.lists(
    st.tuples(st.sampled_from(("lose", "twice", "swap", "late")), st.integers(0, 59)), max_size=25
)


@settings(max_examples=300, deadline=None)
@given(edits)
def test_whatever_gets_lost_doubled_swapped_or_late_no_two_cycles_mix(edits):
    frames = [
        [i, d, k * PERIOD + n * 1e-4, k * PERIOD + n * 1e-4]
        for k in range(20)
        for n, (i, d) in enumerate(cycle(k))
    ]
    for what, where in edits:
        at = where % len(frames)
        if what == "lose":
            del frames[at]
        elif what == "twice":
            frames.insert(at, list(frames[at]))
        elif what == "late":
            frames[at][2] = max(frames[at][2], frames[at][3] + LATE)
        elif at:
            frames[at - 1], frames[at] = frames[at], frames[at - 1]
    found, _ = taken([frame[:3] for frame in frames])
    for joints in found:
        assert len(set(joints)) == 1, joints
    firsts = [joints[0] for joints in found]
    assert firsts == sorted(set(firsts))


ODRIVE = read_profile(CanSettings.shipped / "odrive.yaml")
NODES = range(6)


def odrive_samples(frames):
    """Feed (node, cycle that it says, bus clock in s); return the cycles of each sample."""
    assembler, found = Assembler(ODRIVE), []
    for node, k, stamp in frames:
        data = struct.pack("<ff", k, 0.0)
        sample = assembler.take((node << 5 | 9, False), data, stamp, stamp)
        if sample is not None:
            found.append([round(q / (2.0 * np.pi)) for q in sample.position])
    return found, assembler


@pytest.mark.parametrize("late", [0.0, 0.002, 0.006, 0.0095])
@pytest.mark.parametrize("node", range(5))  # of the last one: six frames in a row, nothing shows
def test_two_cycles_that_come_in_a_burst_are_not_one_sample(node, late):
    """Cycle 3 comes late and lacks one node, which is the first that is heard of cycle 4."""
    frames = []
    for k in range(8):
        lost = {3: [node], 4: range(node)}.get(k, [])
        stamp = k * 0.01 + (late if k == 3 else 0.0)
        frames += [(n, k, stamp + 1e-4 * n) for n in NODES if n not in lost]
    found, assembler = odrive_samples(frames)
    assert all(len(set(cycles)) == 1 for cycles in found), found
    assert {0, 1, 2, 5, 6, 7} <= {cycles[0] for cycles in found}
    assert assembler.broken


def test_whole_cycles_that_come_in_a_burst_are_taken():
    late = {3: 0.03, 4: 0.02, 5: 0.01}
    frames = [(n, k, k * 0.01 + late.get(k, 0.0) + 1e-5 * n) for k in range(9) for n in NODES]
    found, assembler = odrive_samples(frames)
    assert found == [[k] * 6 for k in range(9)]
    assert assembler.broken == 0


def test_nodes_that_drift_past_each_other_lose_no_sample():
    phases = [0.0002 + 0.0012 * n for n in NODES]
    frames = [(n, k, k * (0.01 + 5e-7 * (n == 2)) + phases[n]) for k in range(5000) for n in NODES]
    found, assembler = odrive_samples(sorted(frames, key=lambda frame: frame[2]))
    assert len(found) >= 4998  # one goes where the last node passes the first: it begins the next
    assert assembler.broken <= 1


def test_equal_counts_tie_frames_together_and_a_repeated_sample_is_none():
    profile = read_profile(INVENTED)
    shoulder, hand = profile.sample
    assembler = Assembler(profile)

    def frame(count, angle):
        return (count | (angle & 0xFFFFF) << 4 | (angle & 0xFFFFF) << 24).to_bytes(8, "little")

    assert assembler.take(shoulder, frame(1, 100), 0.0, 0.0) is None
    assert assembler.take(hand, frame(2, 200), 0.001, 0.001) is None
    assert assembler.dropped["torn"] == 1
    assert assembler.take(shoulder, frame(2, 100), 0.0015, 0.0015) is not None
    assembler.take(shoulder, frame(2, 100), 0.004, 0.004)
    assert assembler.take(hand, frame(2, 200), 0.0041, 0.0041) is None
    assert assembler.dropped["repeated"] == 1


def stray_frames(random, number):
    """Random and mutated frames around the identifiers that the profile reads."""
    known = sorted(identifier for identifier, _ in PIPER.incoming)
    lengths = random.choice([0, 1, 7, 8, 8, 8, 8, 8, 8, 8], number)
    picks = random.integers(0, len(known), number)
    strange = random.random(number) < 0.2
    others = random.integers(0, 1 << 29, number)
    data = random.integers(0, 256, (number, 8), dtype=np.uint8)
    small = random.random(number) < 0.5
    data[small, 0] = data[small, 4] = 0
    for k in range(number):
        identifier = int(others[k]) if strange[k] else known[picks[k]]
        extended = identifier > 0x7FF or bool(others[k] & 1 and strange[k])
        yield (identifier, extended), data[k, : lengths[k]].tobytes()


def checked(builder: StateBuilder):
    """Return what makes a sample a state, as the driver's base does: made, checked, remembered."""
    check = SampleCheck(builtin_arm("ur10e"))

    def believed(sample):
        state = builder.build(sample, None, None, ready=True)
        check.check(state)
        builder.remember()
        return state

    return believed


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_stray_frames_raise_nothing_and_no_wrong_sample_is_taken_for_good():
    """Stray frames among a true stream whose every cycle says its own number in all joints.

    A stray frame that stands in for a true one can only be recognised by what an arm can do between
    two samples; one beside the true one makes a sample torn.
    """
    random = np.random.default_rng(7)
    assembler, believed = Assembler(PIPER), checked(StateBuilder(PIPER.n))
    stream = stray_frames(random, 200_000)
    good = wrong = refused = k = 0
    outlier = next(stream, None)
    while outlier is not None:
        k += 1
        now = k * PERIOD
        number = abs((k + 500) % 1000 - 500)
        true = cycle(number) if k % 4 else []  # every fourth cycle is all stray
        places = random.integers(0, 4, 4)
        frames = [((i, False), d) for i, d in true]
        for place in sorted(places.tolist(), reverse=True):
            if outlier is None:
                break
            frames.insert(place, outlier)
            outlier = next(stream, None)
        for n, (key, data) in enumerate(frames):
            sample = assembler.take(key, data, now + n * 1e-4, now + n * 1e-4)
            if sample is None:
                continue
            try:
                state = believed(sample)
            except InvalidStateError:
                refused += 1
                continue
            is_true = np.abs(state.actual_q - 100 * number * UNIT).max() < UNIT
            good, wrong = good + is_true, wrong + (not is_true)
    print(f"{good} true, {refused} refused, {wrong} wrong")
    assert good > 20_000
    assert wrong == 0


@pytest.mark.parametrize("name", ["piper", "invented", *further("openarm", "odrive")])
def test_no_frame_of_any_length_and_content_raises_an_exception(name):
    profile = read_profile(CanSettings.shipped / f"{name}.yaml" if name != "invented" else INVENTED)
    assembler, random = Assembler(profile), np.random.default_rng(3)
    keys = list(profile.incoming)
    for k in range(20_000):
        key = keys[int(random.integers(len(keys)))]
        data = random.bytes(int(random.choice([0, 2, 4, 7, 8, 8, 8, 8])))
        sample = assembler.take(key, data, k * 1e-4, k * 1e-4)
        assert sample is None or sample.position.shape == (profile.n,)
    assert assembler.dropped["malformed"] > 1000


def test_joints_that_no_arm_can_come_to_between_two_samples_are_refused():
    believed = checked(StateBuilder(PIPER.n))

    def state_of(q, at):
        assembler = Assembler(PIPER)
        for first in (1, 3, 5):
            key, data = joints_frame(first, q, q)
            sample = assembler.take((key, False), data, at, at)
        return believed(sample)

    state_of(0.5, 1.0)
    with pytest.raises(InvalidStateError, match=r"found a step of 0\.5000 rad in 0\.0050 s"):
        state_of(1.0, 1.005)
    assert state_of(0.5, 1.01).actual_q == pytest.approx([0.5] * 6, abs=UNIT)
