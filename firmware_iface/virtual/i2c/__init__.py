"""Byte-level models of the laser board's parts, and the bus that the real smbus2 reaches them through.

board = LaserBoard()
node = attach(board.bus)        # a path to give smbus2.SMBus
"""

from firmware_iface.virtual.i2c.bus import I2cBus, Message
from firmware_iface.virtual.i2c.laser_board import LaserBoard
from firmware_iface.virtual.i2c.smbus2_ioctls import attach, detach

__all__ = ["I2cBus", "LaserBoard", "Message", "attach", "detach"]
