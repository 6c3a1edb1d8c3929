"""The wire format: messages of fixed size as named tuples. The type of a field is its type on the wire.

A message is an 8-byte header and the fields in their order, little-endian, each on its natural boundary. So
a C struct of the same fields has the same bytes:

    u16 code    of the message's type
    u16 bytes   of the whole message, header included
    u32 serial  of a request; its answer repeats it; 0 in messages that answer no request
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, get_type_hints

U16 = Annotated[int, "H"]
U32 = Annotated[int, "I"]
U64 = Annotated[int, "Q"]
F32 = Annotated[float, "f"]
Magic = Annotated[bytes, "8s"]
Shares = Annotated[bytes, "156s"]
Brightness = Annotated[bytes, "12s"]
Text = Annotated[str, "240s"]

HEADER = struct.Struct("<HHI")
LARGEST = 512  # bytes of any message; more are not read


class ProtocolError(ValueError):
    """Bytes that are not a message of the protocol: the text says what is wrong."""


class Vocabulary:
    """The messages that may pass over one link.

    Parameters
    ----------
    codes : mapping of int to type
        Message type by code; its fields are annotated with the types above.
    """

    def __init__(self, codes: Mapping[int, type[NamedTuple]]) -> None:
        self._types = dict(codes)
        self._codes = {t: code for code, t in codes.items()}
        self._bodies = {t: struct.Struct("<" + "".join(formats(t))) for t in codes.values()}
        self._texts = {t: [f == "240s" for f in formats(t)] for t in codes.values()}

    def pack(self, message: NamedTuple, serial: int = 0) -> bytes:
        """The bytes of a message; a text that is too long is cut."""
        message_type = type(message)
        body = self._bodies[message_type]
        fields = [
            cut(value) if text else value
            for value, text in zip(message, self._texts[message_type], strict=True)
        ]
        return HEADER.pack(self._codes[message_type], HEADER.size + body.size, serial) + body.pack(*fields)

    def unpack(self, data: bytes) -> tuple[int, Any]:
        """The serial and the message in `data`.

        Raises
        ------
        ProtocolError
            For anything that is not exactly one message.
        """
        if len(data) < HEADER.size:
            raise ProtocolError(f"{len(data)} bytes are no message: a header alone has {HEADER.size}")
        code, size, serial = HEADER.unpack_from(data)
        message_type = self._types.get(code)
        if message_type is None:
            raise ProtocolError(f"message code {code} is not known here")
        body = self._bodies[message_type]
        if not len(data) == size == HEADER.size + body.size:
            raise ProtocolError(
                f"{message_type.__name__} has {HEADER.size + body.size} bytes; "
                f"{len(data)} came and {size} were announced"
            )
        fields: list[Any] = list(body.unpack_from(data, HEADER.size))
        for i, text in enumerate(self._texts[message_type]):
            if text:
                fields[i] = fields[i].split(b"\0", 1)[0].decode("utf-8", "replace")
        return serial, message_type._make(fields)


def formats(message_type: type[NamedTuple]) -> list[str]:
    """The struct format of each field of a message type."""
    hints = get_type_hints(message_type, include_extras=True)
    return [hints[name].__metadata__[0] for name in message_type._fields]


def cut(text: str) -> bytes:
    """A text as UTF-8 that fits its field with a closing zero, cut between characters."""
    return text.encode("utf-8", "replace")[:239].decode("utf-8", "ignore").encode()
