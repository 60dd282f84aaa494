"""Refuses JSON that a parser would take but this service must not: too deep, not finite, not UTF-8; builds no values.

It looks at bytes before any parser does. What it lets through may still be malformed; then the parser says so.
"""

import re

import numpy as np

MAX_DEPTH = 32

# A string up to its closing quote or, if it never closes, to the end. Possessive quantifiers and the open end keep
# the scan linear for every input: nothing is ever tried twice.
_STRING = re.compile(rb'"(?:[^"\\]++|\\.)*+(?:"|\\?\Z)', re.DOTALL)
_LONG_EXPONENT = re.compile(rb"[eE]\+?[0-9]{3}")
_DIGITS_AS_ZERO = bytes(ord("0") if chr(code).isdigit() and code < 128 else code for code in range(256))
# Only numbers that could leave the range of a double: an exponent of three digits, or 309 digits and more.
_LARGE = re.compile(rb"(?<![0-9.])(?:[0-9][0-9.]*+[eE]\+?[0-9]{3,}+|[0-9]{309,}+)")
_NOT_BRACKETS = bytes(sorted(set(range(256)) - set(b"[]{}")))


class JsonRefused(ValueError):
    """JSON that is not taken in, with the reason as one sentence; `slug` names the reason."""

    def __init__(self, slug: str, detail: str) -> None:
        super().__init__(detail)
        self.slug = slug


def check_json(body: bytes, max_depth: int = MAX_DEPTH) -> None:
    """Look through the bytes of a JSON text; linear in its length, whatever it holds.

    Parameters
    ----------
    body : the whole text. Only UTF-8 is JSON between systems (RFC 8259 section 8.1); Python's parser would also
        read UTF-16 and UTF-32, in which the tokens looked for here look different.
    max_depth : how many arrays and objects may be open at once.

    Raises
    ------
    JsonRefused : slug `json-encoding`, `json-not-finite` or `json-depth`.
    """
    if b"\0" in body or not _is_utf8(body):
        raise JsonRefused("json-encoding", "The body is not UTF-8; JSON is sent as UTF-8.")
    bare = _STRING.sub(b'""', body)
    lowered = bare.lower()
    if b"nan" in lowered or b"infinity" in lowered:
        raise JsonRefused("json-not-finite", "NaN and Infinity are not JSON; send null for a value that is missing.")
    if _may_overflow(bare) and any(_overflows(number.group()) for number in _LARGE.finditer(bare)):
        raise JsonRefused("json-not-finite", "A number in the body is too large for a double; send a smaller one.")
    depth = _depth(bare)
    if depth > max_depth:
        raise JsonRefused("json-depth", f"The body nests {depth} levels deep; {max_depth} are allowed.")


def _is_utf8(body: bytes) -> bool:
    try:
        body.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def _may_overflow(bare: bytes) -> bool:
    """A quick look that spares most bodies the slow one."""
    return b"0" * 309 in bare.translate(_DIGITS_AS_ZERO) or _LONG_EXPONENT.search(bare) is not None


def _overflows(number: bytes) -> bool:
    try:
        return float(number) == float("inf")
    except ValueError:  # two points in a number: malformed, the parser's business
        return False


def _depth(bare: bytes) -> int:
    """The largest number of brackets open at once in a text without strings."""
    brackets = np.frombuffer(bare.translate(None, _NOT_BRACKETS), dtype=np.uint8)
    if not len(brackets):
        return 0
    opens = (brackets == ord("[")) | (brackets == ord("{"))
    return int(np.cumsum(np.where(opens, 1, -1)).max())
