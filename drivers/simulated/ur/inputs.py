"""Input fields that do something beside being remembered: bits, digital outputs, speed slider."""

from __future__ import annotations

from typing import Any

_DIGITAL = {  # mask field: (value field, first bit in actual_digital_output_bits)
    "standard_digital_output_mask": ("standard_digital_output", 0),
    "configurable_digital_output_mask": ("configurable_digital_output", 8),
    "tool_digital_output_mask": ("tool_digital_output", 16),
}
_WORDS = {"input_bit_registers0_to_31": 0, "input_bit_registers32_to_63": 32}


def apply_inputs(memory: dict[str, Any], values: dict[str, Any]) -> None:
    """Put a client's input fields into memory, with what they set off."""
    memory.update(values)
    for mask, (value, first) in _DIGITAL.items():
        if mask in values:
            _switch(memory, values[mask], values.get(value, 0), first)
    if values.get("speed_slider_mask"):
        fraction = min(max(memory["speed_slider_fraction"], 0.0), 1.0)
        memory["target_speed_fraction"] = memory["speed_scaling"] = fraction
    if "standard_analog_output_mask" in values:
        _set_analog(memory, values)
    for word, first in _WORDS.items():
        if word in values:
            for i in range(32):
                memory[f"input_bit_register_{first + i}"] = bool(values[word] >> i & 1)


def _switch(memory: dict[str, Any], mask: int, value: int, first: int) -> None:
    bits = memory["actual_digital_output_bits"]
    memory["actual_digital_output_bits"] = (bits & ~(mask << first)) | ((value & mask) << first)


def _set_analog(memory: dict[str, Any], values: dict[str, Any]) -> None:
    """Set the analog outputs that the mask selects; the others carry rubbish (measured)."""
    mask, kind = values["standard_analog_output_mask"], values["standard_analog_output_type"]
    for i in range(2):
        if mask >> i & 1:
            share = values[f"standard_analog_output_{i}"]
            is_voltage = bool(kind >> i & 1)
            memory[f"standard_analog_output{i}"] = share * (10.0 if is_voltage else 0.020)
