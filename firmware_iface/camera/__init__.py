"""Cameras: the Luxonis OAK line, each in a process of its own."""

from firmware_iface.camera.oak import OakCamera, open_oak

__all__ = ["OakCamera", "open_oak"]
