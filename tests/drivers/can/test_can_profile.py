import shutil
from pathlib import Path

import numpy as np
import pytest

from gapbridge.core.errors import InputError
from gapbridge.drivers.can.loading import read_profile
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.profile_file import ProfileError

HERE = Path(__file__).parent
Q = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6])


@pytest.fixture
def folder(tmp_path):
    for name in ("invented.yaml", "invented.dbc"):
        shutil.copy(HERE / name, tmp_path)
    return tmp_path


def broken(folder, file, old, new):
    """Change a text of a file that stands there once; return the line it stands in."""
    path = folder / file
    text = path.read_text()
    assert text.count(old) == 1, text.count(old)
    path.write_text(text.replace(old, new))
    return text[: text.index(old)].count("\n") + 1


def message_of(folder):
    with pytest.raises(ProfileError) as caught:
        read_profile(folder / "invented.yaml")
    text = str(caught.value)
    assert "\n" not in text
    return text


DBC = [
    ("an overlap", "SG_ lift : 24|20@1- (0.0005,0) [0|0] \"deg\" Gapbridge\n SG_ elbow",
     "SG_ lift : 20|20@1- (0.0005,0) [0|0] \"deg\" Gapbridge\n SG_ elbow",
     ["overlap", "swing", "lift"]),
    ("a scale of zero", "SG_ bend : 24|20@1- (0.0005,0) [0|0] \"deg\" Gapbridge",
     "SG_ bend : 24|20@1- (0,0) [0|0] \"deg\" Gapbridge", ["Hand.bend", "scale of 0"]),
    ("a unit that no angle has", "SG_ turn : 44|20@1- (0.0005,0) [0|0] \"deg\" Gapbridge",
     "SG_ turn : 44|20@1- (0.0005,0) [0|0] \"grad\" Gapbridge", ["Hand.turn", "'grad'", "rad, "]),
    ("a signal that does not fit", "SG_ powered : 4|1@1+", "SG_ powered : 40|1@1+",
     ["powered", "does not fit"]),
    ("broken text", "SG_ wanted : 0|1@1+", "SG_ wanted : 0|one@1+",
     ["Invalid syntax", "column 17"]),
    ("a status in some frames only",
     "SG_ alarm : 0|4@1+ (1,0) [0|15] \"\" Gapbridge\n SG_ powered : 4|1@1+",
     "SG_ alarm m0 : 0|4@1+ (1,0) [0|15] \"\" Gapbridge\n SG_ powered M : 4|1@1+",
     ["Health.alarm", "multiplexed signal"]),
    ("a joint in some frames only",
     "SG_ roll : 4|20@1- (0.0005,0) [0|0] \"deg\" Gapbridge\n SG_ bend : 24",
     "SG_ roll m1 : 4|20@1- (0.0005,0) [0|0] \"deg\" Gapbridge\n SG_ bend M : 24",
     ["Hand.roll", "multiplexed signal"]),
    ("a counter in some frames only",
     "SG_ count : 0|4@1+ (1,0) [0|15] \"\" Gapbridge\n SG_ roll : 4|20@1- (0.0005,0)",
     "SG_ count m1 : 0|4@1+ (1,0) [0|15] \"\" Gapbridge\n SG_ roll M : 4|20@1- (0.0005,0)",
     ["Hand.count", "multiplexed signal"]),
    ("a multiplexed setpoint",
     "BO_ 514 GoHand: 8 Gapbridge\n SG_ mode : 0|4@1+ (1,0) [0|15] \"\" Arm\n SG_ roll",
     "BO_ 514 GoHand: 8 Gapbridge\n SG_ mode m1 : 0|4@1+ (1,0) [0|15] \"\" Arm\n SG_ roll M",
     ["GoHand", "multiplexed message"]),
    ("an identifier twice", "BO_ 514 GoHand", "BO_ 513 GoHand", ["GoHand", "0x201", "GoShoulder"]),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "phrase"), [d[1:] for d in DBC], ids=[d[0] for d in DBC])
def test_a_dbc_is_refused_with_the_line_that_is_wrong(folder, old, new, phrase):
    line = broken(folder, "invented.dbc", old, new)
    text = message_of(folder)
    assert text.startswith(f"{folder / 'invented.dbc'}, line {line}: ")
    for word in phrase:
        assert word in text


def test_a_type_that_no_dbc_knows_is_refused_with_its_line(folder):
    path = folder / "invented.dbc"
    path.write_text(path.read_text() + "\nSIG_VALTYPE_ 513 swing : 3;\n")
    line = path.read_text().count("\n")
    assert f"invented.dbc, line {line}: SIG_VALTYPE_ swing: found type 3" in message_of(folder)


YAML = [
    ("a missing joint", "Hand.roll, Hand.bend, Hand.turn]", "Hand.roll, Hand.bend]",
     ["feedback.position.signals", "found 5 signals, expected 6", "joint 6 is missing"]),
    ("a joint twice", "Hand.roll, Hand.bend, Hand.turn]", "Hand.roll, Hand.bend, Hand.bend]",
     ["found Hand.bend twice"]),
    ("an unknown signal", "Shoulder.lift", "Shoulder.left",
     ["'Shoulder.left'", "no signal", "nearest is Shoulder.lift"]),
    ("an unknown message", "messages: [Shoulder, Hand]", "messages: [Shoulder, Hands]",
     ["sample.messages.2", "'Hands'", "nearest is Hand"]),
    ("a sample without a joint's message", "messages: [Shoulder, Hand]", "messages: [Shoulder]",
     ["no Hand", "position of joint 4"]),
    ("an unknown key", "joints: 6", "joint: 6", ["joint: found an unknown key"]),
    ("a window longer than the period", "window: 0.003", "window: 0.03",
     ["sample.window", "0.004"]),
    ("a counter that is not there", "counter: count", "counter: sequence", ["sample.counter"]),
    ("a sign that is none", "[1, -1, 1, 1, -1, 1]", "[1, -1, 1, 2, -1, 1]", ["direction.4"]),
    ("a frame that may not be sent", "sends: [0x200, 0x201, 0x202]", "sends: [0x200, 0x201]",
     ["GoHand (0x202)", "`sends`"]),
    ("feedback that we would send", "sends: [0x200,", "sends: [0x701, 0x200,",
     ["sends.1", "Health, feedback"]),
    ("a constant left out", "{message: GoHand, signals: {mode: 3}}", "{message: GoHand}",
     ["setpoint.frames.2.signals", "no mode"]),
    ("a constant that does not fit", "signals: {wanted: 1}", "signals: {wanted: 2}", ["Power"]),
    ("two conditions on a signal, of which the last alone would count",
     "  - {signal: Health.alarm, normal: [0], values: {2: emergency_stop}}",
     "  - {signal: Health.alarm, normal: [0], values: {2: emergency_stop}}\n"
     "  - {signal: Health.alarm, normal: [0, 1], while_writing: true}",
     ["status.2.signal", "found Health.alarm twice"]),
    ("a stop that we do not know", "2: emergency_stop", "2: explosion", ["status.1.values"]),
    ("broken YAML", "joints: 6", "joints: [6", ["broken YAML"]),
    ("a key twice", "rate: 250", "joints: 6", ["joints: found twice"]),
    ("another DBC", "dbc: invented.dbc", "dbc: other.dbc", ["other.dbc: file not found"]),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "phrase"), [d[1:] for d in YAML], ids=[d[0] for d in YAML])
def test_a_profile_is_refused_with_the_line_and_key_that_are_wrong(folder, old, new, phrase):
    path = folder / "invented.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    found = message_of(folder)
    if "other.dbc" not in found:
        assert found.startswith(f"{path}, line ")
    for word in phrase:
        assert word in found


def test_the_line_named_is_the_line_of_the_key(folder):
    line = broken(
        folder, "invented.yaml", "[Shoulder.swing, Shoulder.lift", "[Shoulder.swing, left"
    )
    assert f"invented.yaml, line {line}: feedback.position.signals.2: " in message_of(folder)


def test_every_shipped_profile_loads_and_its_setpoint_reads_back():
    shipped = sorted(CanSettings.shipped.glob("*.yaml"))
    assert [path.stem for path in shipped] == ["odrive", "openarm", "piper"]
    for path in shipped:
        profile = read_profile(path)
        q = np.resize(Q, profile.n)
        wire = profile.joints.to_wire(q)
        back = np.full(profile.n, np.nan)
        for frame in profile.setpoint:
            data = frame.encode(wire)
            values = frame.message.decode(data, decode_choices=False)
            for signal, joint in frame.joints:
                back[joint] = values[signal]
        again = back * profile.joints.setpoint_scale + profile.joints.zero
        assert again == pytest.approx(q, abs=np.max(profile.joints.resolution) / 2 + 1e-6)


def test_a_request_on_an_identifier_that_commands_hides_no_other_commander(tmp_path):
    """Many programs poll Damiao motors by setpoints without gain."""
    shipped = CanSettings.shipped
    shutil.copy(shipped / "openarm.dbc", tmp_path)
    text = (shipped / "openarm.yaml").read_text()
    poll = "{message: Query, signals: {motor: 1, what: 0xCC}}"
    idle = "{message: Command1, signals: {position: 0, velocity: 0, kp: 0, kd: 0, torque: 0}}"
    assert text.count(poll) == 1
    path = tmp_path / "openarm.yaml"
    path.write_text(text.replace(poll, idle))
    assert read_profile(path).control == read_profile(shipped / "openarm.yaml").control
    asked = text.replace("control: [0x101,", "control: [0x7FF, 0x101,")  # who asks is a commander
    path.write_text(asked)
    assert (0x7FF, False) in read_profile(path).control


@pytest.mark.parametrize("mode", [0x000, 0x100, 0x200, 0x300])
def test_a_damiao_motor_has_a_commander_in_whichever_mode_it_is(mode):
    control = read_profile(CanSettings.shipped / "openarm.yaml").control
    assert {(mode + motor, False) for motor in range(1, 8)} <= control


def test_a_negative_gear_turns_torque_too_as_a_direction_does():
    profiles = [
        read_profile(CanSettings.shipped / "openarm.yaml", {key: [-1] * 7})
        for key in ("gear", "direction")
    ]
    scales = [profile.joints.scale for profile in profiles]
    assert set(scales[0]) >= {"position", "velocity", "torque"}
    for name, scale in scales[0].items():
        assert scale.tolist() == scales[1][name].tolist(), name


def test_direction_zero_and_gear_of_the_installation_stand_before_the_profiles():
    profile = read_profile(
        CanSettings.shipped / "odrive.yaml",
        {"gear": [8.0] * 6, "zero": [0.1] * 6, "direction": [-1] * 6},
    )
    turns = profile.joints.to_wire(np.full(6, 0.1 + 2.0 * np.pi))
    assert turns == pytest.approx([-8.0] * 6)


@pytest.mark.parametrize(
    ("key", "values", "found"),
    [
        ("gear", [8.0, 8.0], "found 2 values, expected 6"),
        ("gear", [8.0] * 5 + [0.0], "found 0, expected a ratio that is not zero"),
        ("zero", [0.1], "found 1 values, expected 6"),
    ],
)
def test_a_wrong_value_of_the_installation_is_reported_as_the_links(key, values, found):
    with pytest.raises(ProfileError) as caught:
        read_profile(CanSettings.shipped / "odrive.yaml", {key: values})
    assert (caught.value.keys, caught.value.message) == (("link", key), found)


def test_a_profile_that_is_not_shipped_is_refused_with_those_that_are():
    with pytest.raises(InputError, match=r"found 'pipr', expected one of odrive, openarm, piper"):
        CanSettings(profile="pipr").located(Path())
