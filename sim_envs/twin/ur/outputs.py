"""A UR's digital and analog outputs, as RTDE's inputs set them and its outputs show them."""

# Standard outputs are bits 0 to 7 of `actual_digital_output_bits`, configurable ones 8 to 15, the tool's
# 16 and 17 (RTDE guide).
_GROUPS = (
    ("standard_digital_output", 0),
    ("configurable_digital_output", 8),
    ("tool_digital_output", 16),
)


class Outputs:
    """What the outputs are set to.

    Attributes:
        digital: bits, see `_GROUPS`.
        analog: of the two analog outputs, share of their range.
    """

    def __init__(self) -> None:
        self.digital, self.analog = 0, [0.0, 0.0]

    def update(self, inputs: dict[str, float], names: list[str]) -> None:
        """Take what a package has set, where its masks say so."""
        for name, first in _GROUPS:
            if f"{name}_mask" in names and name in names:
                mask = int(inputs[f"{name}_mask"]) << first
                self.digital = self.digital & ~mask | (int(inputs[name]) << first) & mask
        if "standard_analog_output_mask" in names:
            mask = int(inputs["standard_analog_output_mask"])
            for i in (0, 1):
                if mask >> i & 1:
                    self.analog[i] = float(inputs[f"standard_analog_output_{i}"])
