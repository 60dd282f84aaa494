"""Session ids: short, in the order of their making; knows no clock and no database.

Nine letters of milliseconds since 1970 and five of chance, in Crockford's base 32 (no i, l, o, u), so that ids sort
as text in the order in which the sessions were made.
"""

import random
import re

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"
_TIME_LETTERS = 9
_CHANCE_LETTERS = 5
_PATTERN = re.compile(f"[{_ALPHABET}]{{{_TIME_LETTERS + _CHANCE_LETTERS}}}")


def new_session_id(milliseconds: int, rng: random.Random, newest: str | None) -> str:
    """An id for a session made now, after that of the `newest` session even when the clock went back meanwhile."""
    if newest is not None and _PATTERN.fullmatch(newest):
        milliseconds = max(milliseconds, _number(newest[:_TIME_LETTERS]) + 1)
    return _letters(milliseconds, _TIME_LETTERS) + _letters(rng.getrandbits(5 * _CHANCE_LETTERS), _CHANCE_LETTERS)


def _letters(number: int, count: int) -> str:
    return "".join(_ALPHABET[number >> 5 * place & 31] for place in reversed(range(count)))


def _number(letters: str) -> int:
    number = 0
    for letter in letters:
        number = number << 5 | _ALPHABET.index(letter)
    return number
