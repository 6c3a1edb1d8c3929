"""The Class 1 budget of one board's lasers: what is predicted of the next pattern, and which powers it allows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from firmware_iface.errors import InputError
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.eye_safety import ALL_IN_ONE_SPOT, Exposure, GatedLight, exposure


class LightBudget:
    """The budget; without a prediction, all light counts as one spot.

    Parameters
    ----------
    channels : sequence of LaserChannel
    gated : GatedLight or None
        How the panel gates the lasers to fields; None: they shine all the time. The budget holds for the sum over the
        fields of a frame.
    """

    def __init__(self, channels: Sequence[LaserChannel], gated: GatedLight | None = None) -> None:
        self._gated = gated
        self._full_power_uw = {c.name: c.full_power_uw for c in channels}
        self._wavelength_nm = {c.name: c.wavelength_nm for c in channels}
        self._shares: dict[str, tuple[float, ...]] = {}

    def expect(self, shares: Mapping[str, Sequence[float]] | None) -> None:
        """Take the prediction for the next pattern.

        Parameters
        ----------
        shares : mapping of channel to sequence of float, or None
            From `eye_safety.spot_shares`; None: nothing is known.

        Raises
        ------
        InputError
            Where a channel is unknown or the shares are not those of `spot_shares`.
        """
        found = {}
        for channel, values in (shares or {}).items():
            if channel not in self._full_power_uw:
                raise InputError(
                    f"there is no laser '{channel}'; use one of {', '.join(self._full_power_uw)}."
                )
            values = tuple(float(v) for v in values)
            if len(values) != len(ALL_IN_ONE_SPOT) or not all(0 < v <= 1 for v in values):
                raise InputError(
                    f"the shares of '{channel}' are not what spot_shares gives; use it to make them."
                )
            found[channel] = values
        self._shares = found

    def exposure(self, fractions: Mapping[str, float]) -> Exposure:
        """Shares of the Class 1 limits at fractions of full power, by channel, with the prediction in force."""
        return exposure(self._power_uw(fractions), self._wavelength_nm, self._shares, self._gated)

    def exposure_at_full_power(self) -> Exposure:
        """Shares of the Class 1 limits with all lasers at full power, in one spot, as if no gate ever closed."""
        return exposure(self._full_power_uw, self._wavelength_nm)

    def check(self, fractions: Mapping[str, float]) -> None:
        """Check fractions of full power, by channel.

        Raises
        ------
        InputError
            Where they would exceed the budget.
        """
        worst = self.exposure(fractions).worst
        if worst > 1 + 1e-9:
            raise InputError(
                f"the lasers together would make {worst:.2f} of the Class 1 limit of a point source; lower one, or "
                "say with expect() what the pattern is predicted to make."
            )

    def _power_uw(self, fractions: Mapping[str, float]) -> dict[str, float]:
        return {name: full * fractions[name] for name, full in self._full_power_uw.items()}
