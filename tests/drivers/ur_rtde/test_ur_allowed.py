"""What the robot library can do beyond our job is out of reach."""

import pytest

from gapbridge.core.errors import WriteError
from gapbridge.drivers.ur_rtde import registers
from gapbridge.drivers.ur_rtde.command import CONTROL, AllowedControl, AllowedInputs


class Library:
    """Counts what reaches it; the library's own names."""

    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        return lambda *given: self.calls.append((name, given)) or True


def test_every_call_of_the_list_exists_in_the_library():
    from rtde_control import RTDEControlInterface

    assert all(hasattr(RTDEControlInterface, name) for name in CONTROL)


@pytest.mark.parametrize(
    "name", ["moveJ", "moveL", "speedJ", "sendCustomScript", "setPayload", "teachMode", "setTcp"]
)
def test_other_motions_and_scripts_raise_before_the_socket(name):
    library = Library()
    control = AllowedControl("127.0.0.1", library)
    with pytest.raises(WriteError, match=name):
        getattr(control, name)([0.0] * 6)
    assert library.calls == []
    assert control.servoJ([0.0] * 6)
    assert library.calls[0][0] == "servoJ"


def test_only_the_registers_of_the_offset_can_be_written():
    library = Library()
    inputs = AllowedInputs("127.0.0.1", library)
    for register in range(48):
        for call, allowed in (
            (inputs.setInputDoubleRegister, registers.OFFSET_DOUBLES),
            (inputs.setInputIntRegister, (18, 19, 20, 21, 22)),
        ):
            if register in allowed:
                assert call(register, 1)
            else:
                with pytest.raises(WriteError, match=str(register)):
                    call(register, 1)
    assert len(library.calls) == 10
    with pytest.raises(AttributeError):
        inputs.setSpeedSlider(1.0)
