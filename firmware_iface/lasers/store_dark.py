"""Write the DAC's EEPROM dark, once when a board is made: python -m firmware_iface.lasers.store_dark /dev/i2c-1"""

from __future__ import annotations

import sys
import time

from firmware_iface.lasers.i2c_transfers import open_bus
from firmware_iface.lasers.mcp4728 import Mcp4728


def main(arguments: list[str]) -> int:
    """Write and verify; exit code 0 when the DAC's power-on state is dark, else 2 with one line on stderr."""
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print(__doc__, file=sys.stderr)
        return 2
    try:
        with open_bus(arguments[0]) as bus:
            dac = Mcp4728(bus)
            dac.store_dark()
            time.sleep(0.06)
            dark = all(output.dark for output in dac.read()[1])
    except (OSError, RuntimeError) as error:
        print(f"{arguments[0]}: {error}; check the bus and the board's power", file=sys.stderr)
        return 2
    print("the DAC is dark at power-on" if dark else "the DAC's EEPROM did not take it; replace the DAC")
    return 0 if dark else 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
