"""Byte-level models of the laser board's parts, and the bus that the real smbus2 reaches them through.

board = LaserBoard()
node = attach(board.bus)        # a path to give smbus2.SMBus
"""

from .board import LaserBoard
from .bus import I2cBus, Message
from .kernel import attach, detach

__all__ = ["I2cBus", "LaserBoard", "Message", "attach", "detach"]
