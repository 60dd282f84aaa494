"""Lets published clients run on a pseudo-terminal, which has no DTR: switching it then does nothing."""

import serial


def allow() -> None:
    """Make `dtr` of every open port a plain attribute; nothing else of the client is touched."""
    serial.Serial.dtr = property(lambda self: True, lambda self, value: None)
    serial.Serial.setDTR = lambda self, value=True: None
