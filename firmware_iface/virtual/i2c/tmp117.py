"""TMP117, thermometer with limits, after its data sheet."""

from __future__ import annotations

from collections.abc import Callable

from .words import WordRegisters, signed

TEMPERATURE, CONFIG, HIGH, LOW, IDENTITY = 0, 1, 2, 3, 0xF
STEP_C = 7.8125e-3
THERM_MODE = 0x0010


class Tmp117(WordRegisters):
    """The thermometer.

    celsius : the temperature it feels

    Attributes: alert (whether the ALERT pin is asserted).
    """

    def __init__(self, celsius: Callable[[], float]) -> None:
        self._celsius = celsius
        self.power_on()

    def power_on(self) -> None:
        """Reset values: limits far away."""
        self._registers = {CONFIG: 0x0220, HIGH: 0x6000, LOW: 0x8000, IDENTITY: 0x0117}
        self.alert = False

    def _word(self) -> int:
        return max(-32768, min(32767, round(self._celsius() / STEP_C))) & 0xFFFF

    def settle(self) -> None:
        """Compare with the limits: in therm mode ALERT holds until it is colder than the low limit."""
        now = signed(self._word())
        high, low = signed(self._registers[HIGH]), signed(self._registers[LOW])
        if now > high:
            self.alert = True
        elif self._registers[CONFIG] & THERM_MODE:
            self.alert = self.alert and now >= low
        elif now < low:
            self.alert = True

    def fetch(self, register: int) -> int:
        """A register; data is always ready. In alert mode, reading the configuration releases ALERT."""
        self.settle()
        if register == TEMPERATURE:
            return self._word()
        if register == CONFIG:
            value = self._registers[CONFIG] & 0x0FFC | 0x2000 | self.alert << 15
            if not self._registers[CONFIG] & THERM_MODE:
                self.alert = False
            return value
        return self._registers.get(register, 0)

    def store(self, register: int, value: int) -> None:
        """Configuration and limits can be written; bit 1 of the configuration resets the part."""
        if register == CONFIG and value & 2:
            self.power_on()
        elif register in (CONFIG, HIGH, LOW):
            self._registers[register] = value
