"""The laser channels of a board: wavelength and calibration of each."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_iface.errors import InputError
from firmware_iface.lasers.mcp4728 import VOLTS_PER_CODE
from firmware_iface.toml_tables import check_instance, parameter

MA_PER_V = 50.0  # of the laser-diode controllers' modulation inputs
PHOTODIODE_FULL_V = 1.0


@dataclass(frozen=True)
class LaserChannel:
    """One laser and its calibration.

    The laser-diode controller's own set point must be 0 (its modulation input adds to it), and its hardware limit set
    to what the diode tolerates. The photodiode's amplifier is set to 1 V at full power.

    Raises
    ------
    InputError
        For a value out of range.
    """

    name: str = parameter(about="name of the colour")
    wavelength_nm: float = parameter(about="wavelength", low=400, high=700)
    full_power_uw: float = parameter(
        about="power at fraction 1, through 7 mm at the exit pupil", low=0.01, high=1e5
    )
    threshold_ma: float = parameter(about="current at which light begins", low=0, high=100)
    slope_uw_per_ma: float = parameter(
        about="light for each mA beyond, at the exit pupil", low=1e-3, high=1e5
    )

    def __post_init__(self) -> None:
        check_instance(self, f"laser '{self.name}'")
        if self.drive_v(1.0) > 4095 * VOLTS_PER_CODE:
            raise InputError(
                f"laser '{self.name}' needs {self.drive_v(1.0) * MA_PER_V:.1f} mA for full power and the DAC gives "
                f"at most {4095 * VOLTS_PER_CODE * MA_PER_V:.1f} mA; lower full_power_uw."
            )

    def drive_v(self, fraction: float) -> float:
        """Voltage at the modulation input for a fraction of full power, V; 0 for darkness."""
        if fraction <= 0:
            return 0.0
        return (self.threshold_ma + fraction * self.full_power_uw / self.slope_uw_per_ma) / MA_PER_V

    def code(self, fraction: float) -> int:
        """The DAC's code for a fraction of full power, rounded down: never more light than requested."""
        return int(self.drive_v(fraction) / VOLTS_PER_CODE + 1e-9)

    def photodiode_v(self, drive_v: float) -> float:
        """Voltage of the photodiode at a voltage at the modulation input, V."""
        power_uw = self.slope_uw_per_ma * max(0.0, drive_v * MA_PER_V - self.threshold_ma)
        return PHOTODIODE_FULL_V * power_uw / self.full_power_uw


# the board that firmware_iface.virtual.i2c emulates
VIRTUAL_CHANNELS = (
    LaserChannel("red", 638.0, 120.0, 45.0, 4.0),
    LaserChannel("green", 520.0, 100.0, 40.0, 4.0),
    LaserChannel("blue", 450.0, 15.0, 30.0, 1.0),
)
