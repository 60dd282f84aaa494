"""LZF, the packing inside compressed PCD files (M. Lehmann's LibLZF): bytes in, bytes out; allocates what it made."""

_MOST_PER_BYTE = 88  # a copy of 264 bytes takes 3


class LzfDamaged(ValueError):
    """The packed bytes are none, or not as many as was said."""


def decompressed(packed: bytes, size: int) -> bytes:
    """The `size` bytes that were packed.

    Raises
    ------
    LzfDamaged : they are not what `packed` holds, or more than it could hold.
    """
    if size > _MOST_PER_BYTE * len(packed) + 264:
        raise LzfDamaged(f"{len(packed)} packed bytes cannot hold {size}")
    out = bytearray()
    at, end = 0, len(packed)
    while at < end:
        control = packed[at]
        at += 1
        if control < 32:  # a run of bytes as they are
            if at + control + 1 > end:
                raise LzfDamaged("they end within a run")
            out += packed[at : at + control + 1]
            at += control + 1
        else:  # a copy of what was unpacked before
            length = control >> 5
            if length == 7 and at < end:
                length += packed[at]
                at += 1
            if at >= end:
                raise LzfDamaged("they end within a copy")
            start = len(out) - ((control & 31) << 8) - packed[at] - 1
            at += 1
            if start < 0:
                raise LzfDamaged("a copy begins before the first byte")
            length += 2
            if start + length <= len(out):
                out += out[start : start + length]
            else:  # it overlaps itself: a pattern that repeats
                pattern = bytes(out[start:])
                out += (pattern * (length // len(pattern) + 1))[:length]
        if len(out) > size:
            raise LzfDamaged(f"they hold more than {size} bytes")
    if len(out) != size:
        raise LzfDamaged(f"they hold {len(out)} bytes, not {size}")
    return bytes(out)
