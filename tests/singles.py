"""Chunks one by one, however many of them were read in one go."""

from collections.abc import Iterable

from drivers.protocols.framing import Damage
from drivers.protocols.native_messages import Chunk, Message


def apart(found: Iterable[Message | Damage]) -> list[Message | Damage]:
    """The same items in the same order, every chunk for itself."""
    return [single for item in found for single in (item.apart() if isinstance(item, Chunk) else (item,))]
