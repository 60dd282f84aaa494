"""Memory of large arrays given back to the system as soon as they are freed; knows the C library, no array."""

import ctypes

_MMAP_THRESHOLD = -3
_BYTES = 1 << 20


def give_memory_back() -> None:
    """Have the C library map every block of a megabyte or more by itself; does nothing where it cannot be told.

    By default glibc learns from what is freed, and keeps blocks of up to 32 MB for later: the arrays of a million
    points, whose peak is then the sum of all that was ever needed at once, and of the gaps between.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _BYTES)
