"""TMP117, thermometer with limits, after its data sheet."""

from __future__ import annotations

from collections.abc import Callable

from firmware_iface.virtual.i2c.word_registers import WordRegisters, signed

TEMPERATURE, CONFIG, HIGH, LOW, OFFSET, IDENTITY = 0, 1, 2, 3, 7, 0xF
STEP_C = 7.8125e-3
SOFT_RESET, THERM_MODE, WRITABLE, DATA_READY = 0x0002, 0x0010, 0x0FFC, 0x2000


class Tmp117(WordRegisters):
    """The thermometer. It accepts averaging and modes, which have no effect: data is always fresh.

    Parameters
    ----------
    celsius : callable
        Gives the temperature, °C.
    """

    def __init__(self, celsius: Callable[[], float]) -> None:
        self._celsius = celsius
        self.power_on()

    def power_on(self) -> None:
        """Reset values: limits far away."""
        self._registers = {CONFIG: 0x0220, HIGH: 0x6000, LOW: 0x8000, OFFSET: 0, IDENTITY: 0x0117}
        self._too_hot = self._too_cold = False

    @property
    def alert(self) -> bool:
        """Whether the ALERT pin is asserted."""
        return self._too_hot or self._too_cold

    def _counts(self) -> int:
        counts = round(self._celsius() / STEP_C) + signed(self._registers[OFFSET])
        return max(-32768, min(32767, counts))

    def settle(self) -> None:
        """Compare with the limits: in therm mode ALERT holds until it is colder than the low limit."""
        now, high, low = self._counts(), signed(self._registers[HIGH]), signed(self._registers[LOW])
        if self._registers[CONFIG] & THERM_MODE:
            self._too_hot, self._too_cold = now > high or (self._too_hot and now >= low), False
        else:
            self._too_hot, self._too_cold = self._too_hot or now > high, self._too_cold or now < low

    def fetch(self, register: int) -> int:
        """A register. In alert mode, reading the configuration releases ALERT."""
        self.settle()
        if register == TEMPERATURE:
            return self._counts() & 0xFFFF
        if register == CONFIG:
            flags = self._too_hot << 15 | self._too_cold << 14 | DATA_READY
            if not self._registers[CONFIG] & THERM_MODE:
                self._too_hot = self._too_cold = False
            return self._registers[CONFIG] & WRITABLE | flags
        return self._registers.get(register, 0)

    def store(self, register: int, value: int) -> None:
        """Configuration, limits and offset can be written; bit 1 of the configuration resets the part."""
        if register == CONFIG and value & SOFT_RESET:
            self.power_on()
        elif register in (CONFIG, HIGH, LOW, OFFSET):
            self._registers[register] = value
