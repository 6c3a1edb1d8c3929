"""Panels and cameras that slmsuite drives, behind the interfaces used here: pass its SLM or camera object.

panel = SlmsuitePanel(SLM(...))
camera = SlmsuiteCamera(Camera(...))
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.panel.panel import checked_gray


class SlmsuitePanel:
    """A panel behind an slmsuite SLM object.

    Gray levels go to it as they are, as display values: slmsuite's own wavefront correction and its sign of
    phase do not touch them. On a panel of more than 8 bits, gray is scaled to its range.

    Attributes
    ----------
    slm : slmsuite SLM
    shape : (int, int)
        (H, W), pixels.
    """

    def __init__(self, slm: Any) -> None:
        self.slm = slm
        self.shape: tuple[int, int] = (int(slm.shape[0]), int(slm.shape[1]))
        self._bits = int(slm.bitdepth)

    def show(self, gray: NDArray[np.generic]) -> None:
        """Show gray levels and wait for the panel to settle.

        Parameters
        ----------
        gray : uint8 array [H, W]

        Raises
        ------
        InputError
            For another type or size.
        DeviceError
            Where slmsuite fails.
        """
        levels: NDArray[Any] = checked_gray(gray, self.shape)
        if self._bits > 8:
            levels = levels.astype(np.uint16) << (self._bits - 8)
        elif self._bits < 8:
            levels = levels >> (8 - self._bits)
        try:
            self.slm.set_phase(levels, settle=True)
        except Exception as error:  # vendors' libraries raise any exception
            raise DeviceError(f"slmsuite's panel did not take a pattern: {error}") from error

    def status(self) -> dict[str, Any]:
        """Name and settings, as slmsuite reports them."""
        return {"name": str(getattr(self.slm, "name", "")), "bit_depth": self._bits}

    def close(self) -> None:
        """Close the panel."""
        self.slm.close()


class SlmsuiteCamera:
    """A camera behind an slmsuite camera object.

    Attributes
    ----------
    camera : slmsuite camera
    shape : (int, int)
        (h, w), pixels.
    bit_depth : int
    """

    def __init__(self, camera: Any) -> None:
        self.camera = camera
        self.shape: tuple[int, int] = (int(camera.shape[0]), int(camera.shape[1]))
        self.bit_depth = int(camera.bitdepth)

    @property
    def exposure_ms(self) -> float:
        """Exposure time, ms.

        Raises
        ------
        InputError
            On setting, where the camera does not take it.
        """
        return float(self.camera.get_exposure()) * 1000

    @exposure_ms.setter
    def exposure_ms(self, value: float) -> None:
        self.camera.set_exposure(value / 1000)
        if abs(self.exposure_ms - value) > 0.05 * value:
            raise InputError(
                f"exposure {value!r} ms is out of this camera's range: it took {self.exposure_ms:g} ms."
            )

    def capture(self) -> NDArray[np.uint16]:
        """One picture, exposed after this call.

        Returns
        -------
        uint16 array [h, w], counts

        Raises
        ------
        DeviceError
            Where slmsuite fails or the picture is not plain monochrome.
        """
        try:
            self.camera.flush()
            picture = np.asarray(self.camera.get_image(hdr=False, averaging=False))
        except Exception as error:
            raise DeviceError(f"slmsuite's camera gave no picture: {error}") from error
        if picture.shape != self.shape or picture.min() < 0 or picture.max() >= 1 << self.bit_depth:
            raise DeviceError(
                f"slmsuite's camera gave {picture.shape} values up to {picture.max()} instead of "
                f"{self.shape} counts of {self.bit_depth} bits; set it to plain monochrome pictures."
            )
        return picture.astype(np.uint16)

    def status(self) -> dict[str, Any]:
        """Name and settings, as slmsuite reports them."""
        return {"name": str(getattr(self.camera, "name", "")), "exposure_ms": self.exposure_ms}

    def close(self) -> None:
        """Close the camera."""
        self.camera.close()
