"""What opening a stage needs to be told, and the check of the options that a rig file gives it; knows no controller."""

import difflib
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from drivers.errors import DriverError
from drivers.port import ModemLines
from drivers.rig_limits import Interval

Option = str | int | float | bool


@dataclass(frozen=True, slots=True)
class OptionSpec:
    """An option of a driver: its default (whose type it must have), what it is for, and its choices if it has any."""

    default: Option
    text: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StageSetup:
    """Where a stage is, and within which limits it may be driven.

    `mm_per_unit` is millimetres of travel in one unit (mm or degree) of the controller; `options` are checked already
    and complete. `patience_s` is how long `enter` waits for an answer.
    """

    port_name: str = ""
    baud_rate: int = 0
    travel_mm: Interval = (-math.inf, math.inf)
    speed_mm_per_s: Interval = (0.0, math.inf)
    mm_per_unit: float = 1.0
    options: Mapping[str, Option] = field(default_factory=lambda: MappingProxyType({}))
    clock: Callable[[], float] = time.monotonic
    patience_s: float = 12.0

    def text(self, name: str) -> str:
        """Return an option that is a text."""
        return str(self.options[name])

    def number(self, name: str) -> float:
        """Return an option that is a number."""
        return float(self.options[name])

    def flag(self, name: str) -> bool:
        """Return an option that is true or false."""
        return bool(self.options[name])


DTR = OptionSpec(True, "false keeps DTR down, for boards that start anew when it rises")
DTR_LINES = {True: ModemLines(), False: ModemLines(dtr=False, rts=False, hang_up=False)}


def complete_options(kind: str, specs: Mapping[str, OptionSpec], given: Mapping[str, Option]) -> Mapping[str, Option]:
    """Return the options of a driver, the ones not given by their defaults.

    Raises
    ------
    DriverError : an option is unknown, or of a wrong type.
    """
    for name in given:
        if name not in specs:
            near = difflib.get_close_matches(name, specs, 1)
            hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(specs) or 'none'}"
            raise DriverError(f"{kind} has no option {name}; {hint}")
    return MappingProxyType({name: _checked(kind, name, spec, given) for name, spec in specs.items()})


def _checked(kind: str, name: str, spec: OptionSpec, given: Mapping[str, Option]) -> Option:
    value = given.get(name, spec.default)
    wanted = {bool: "true or false", str: "a text", int: "a whole number", float: "a number"}[type(spec.default)]
    is_right = type(value) is type(spec.default) or (isinstance(spec.default, float) and type(value) is int)
    if not is_right or (isinstance(value, float) and not math.isfinite(value)):
        raise DriverError(f"option {name} of {kind} must be {wanted}, not {value!r}")
    if spec.choices and value not in spec.choices:
        raise DriverError(f"option {name} of {kind} must be one of {', '.join(spec.choices)}, not {value!r}")
    return value
