"""The device's half of each protocol: bytes in, bytes out, time passed in."""
