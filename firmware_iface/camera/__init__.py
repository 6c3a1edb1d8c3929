"""Cameras: the Luxonis OAK line, each in a process of its own."""

from .oak import OakCamera, open_oak

__all__ = ["OakCamera", "open_oak"]
