"""ADS1115, 16-bit converter with a comparator, after its data sheet."""

from __future__ import annotations

from collections.abc import Callable

from firmware_iface.virtual.i2c.word_registers import WordRegisters, signed

CONVERSION, CONFIG, LOW, HIGH = range(4)
FULL_SCALE_V = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)
RATE_SPS = (8, 16, 32, 64, 128, 250, 475, 860)
PAIRS = ((0, 1), (0, 3), (1, 3), (2, 3))


class Ads1115(WordRegisters):
    """The converter.

    Parameters
    ----------
    clock : callable
        Gives the time, s.
    volts : callable
        Gives the voltage at input 0 to 3, V.

    Attributes
    ----------
    alert : bool
        Whether the ALERT pin is asserted.
    """

    def __init__(self, clock: Callable[[], float], volts: Callable[[int], float]) -> None:
        self._clock, self._volts = clock, volts
        self.power_on()

    def power_on(self) -> None:
        """Reset values: idle, comparator off."""
        self._registers = [0, 0x8583, 0x8000, 0x7FFF]
        self._started: float | None = None  # when the running conversion began
        self._exceeded = 0  # conversions in a row beyond the threshold
        self.alert = False

    @property
    def _config(self) -> int:
        return self._registers[CONFIG]

    def settle(self) -> None:
        """Finish the conversions that are due by now."""
        if self._started is None:
            return
        period = 1 / RATE_SPS[self._config >> 5 & 7]
        done = int((self._clock() - self._started) / period + 1e-6)
        if done < 1:
            return
        self._convert(min(done, 4))
        continuous = not self._config & 0x100
        self._started = self._started + done * period if continuous else None

    def _convert(self, times: int) -> None:
        mux = self._config >> 12 & 7
        volts = self._volts(mux - 4) if mux >= 4 else self._volts(PAIRS[mux][0]) - self._volts(PAIRS[mux][1])
        counts = round(volts / FULL_SCALE_V[self._config >> 9 & 7] * 32768)
        value = max(-32768, min(32767, counts))
        self._registers[CONVERSION] = value & 0xFFFF
        queue = self._config & 3
        if queue == 3:
            self.alert = False
            return
        low, high = signed(self._registers[LOW]), signed(self._registers[HIGH])
        window, latching = self._config & 0x10, self._config & 0x04
        beyond = value > high or (bool(window) and value < low)
        self._exceeded = self._exceeded + times if beyond else 0
        if self._exceeded >= (1, 2, 4)[queue]:
            self.alert = True
        elif not latching and (value < low or (bool(window) and not beyond)):
            self.alert = False

    def fetch(self, register: int) -> int:
        """A register; reading the conversion releases a latched ALERT."""
        self.settle()
        register &= 3
        if register == CONVERSION:
            self.alert = False
        if register == CONFIG:
            return (self._config & 0x7FFF) | (self._started is None or not self._config & 0x100) << 15
        return self._registers[register]

    def store(self, register: int, value: int) -> None:
        """A new configuration begins a conversion, unless it is single-shot without OS."""
        self.settle()
        register &= 3
        if register == CONVERSION:
            return
        self._registers[register] = value
        if register == CONFIG:
            self._exceeded = 0
            runs = not value & 0x100 or value & 0x8000
            self._started = self._clock() if runs else None
