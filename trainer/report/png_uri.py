"""A picture as a PNG inside a page."""

from __future__ import annotations

import base64
import io

from PIL import Image


def png_uri(picture: Image.Image) -> str:
    """The picture as a data URI."""
    stream = io.BytesIO()
    picture.save(stream, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
