"""From the plain values of a rig file or a command line to a driver's options; knows no driver.

Degrees become radians here, and pairs that such places cannot write are put together from two names.
"""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from drivers.errors import DriverError

Value = str | int | float | bool
T = TypeVar("T")

_PAIRS: dict[str, tuple[str, str, float]] = {
    "field_of_view_rad": ("from_deg", "to_deg", math.pi / 180.0),
    "variant": ("scan_angle_deg", "resolution_hundredths_deg", 1.0),
}


def options_from(kind: type[T], values: Mapping[str, Value]) -> T:
    """Return the options of a driver, of the class `kind`, with these values in place of its defaults.

    Raises
    ------
    DriverError : for a name that it does not have, half a pair, or a value that cannot be.
    """
    names = {item.name for item in fields(kind)}  # type: ignore[arg-type]  # every options class is a dataclass
    left = dict(values)
    given: dict[str, Any] = {}
    for name in names & _PAIRS.keys():
        low, high, factor = _PAIRS[name]
        if low in left or high in left:
            if low not in left or high not in left:
                raise DriverError(f"{low} and {high} are given together or not at all")
            pair = [left.pop(low), left.pop(high)]
            if not all(isinstance(end, int | float) and not isinstance(end, bool) for end in pair):
                raise DriverError(f"{low} and {high} must be numbers, not {pair[0]!r} and {pair[1]!r}")
            given[name] = tuple(end if factor == 1.0 else float(end) * factor for end in pair)
    plain = {item.name: item.default for item in fields(kind) if item.name not in _PAIRS}  # type: ignore[arg-type]
    for name, value in left.items():
        if name not in plain or not isinstance(plain[name], Value | None):
            known = [*(end for pair in names & _PAIRS.keys() for end in _PAIRS[pair][:2]), *_scalars(plain)]
            raise DriverError(f"this scanner has no option {name!r}; its options are {', '.join(known)}")
        if not _fits(value, plain[name]):
            raise DriverError(f"{name} cannot be {value!r}")
        given[name] = value
    try:
        return kind(**given)
    except ValueError as error:
        raise DriverError(str(error)) from error


def _scalars(plain: Mapping[str, Any]) -> list[str]:
    return [name for name, default in plain.items() if isinstance(default, Value | None)]


def _fits(value: Value, default: Any) -> bool:
    """True when a value is of its default's kind; a default of None stands for a number or a yes and no."""
    if default is None:
        return not isinstance(value, str)
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    if isinstance(default, str) or isinstance(value, str):
        return isinstance(default, str) and isinstance(value, str)
    return isinstance(default, float) or isinstance(value, int)
