"""The stages this project can read or drive, by name, and those that others have added by an entry point.

A name here is what a rig file may say. It knows no controller itself.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeAlias

from drivers.errors import DriverUnknown, PortError, StageError
from drivers.plugins import STAGES_GROUP, added, find_added
from drivers.rig_description import RigDescription
from drivers.stages import grbl, marlin, zaber
from drivers.stages.face import Stage
from drivers.stages.setup import Option, OptionSpec, StageSetup, complete_options
from drivers.stages.unmoved import CONSTANT_SPEED_OPTIONS, ConstantSpeed, EncoderOnScanner

Opener: TypeAlias = Callable[[StageSetup], Stage]


@dataclass(frozen=True, slots=True)
class KnownStage:
    """A kind of stage.

    `baud_rates` are those worth trying, the likeliest first; () for one without a port. `opens` makes a driver that is
    not yet entered. `is_driven` tells a `DrivenStage`.
    """

    name: str
    title: str
    baud_rates: tuple[int, ...]
    opens: Opener
    is_driven: bool = True
    probe_options: Mapping[str, Option] = field(default_factory=lambda: MappingProxyType({}))
    """Options with which it may be asked who it is, where its own defaults do not do."""
    options: Mapping[str, OptionSpec] = field(default_factory=lambda: MappingProxyType({}))


KNOWN: Mapping[str, KnownStage] = MappingProxyType(
    {
        known.name: known
        for known in (
            KnownStage("grbl", "GRBL 1.1 and its descendants", grbl.BAUD_RATES, grbl.open_grbl, options=grbl.OPTIONS),
            KnownStage("marlin", "Marlin", marlin.BAUD_RATES, marlin.open_marlin, options=marlin.OPTIONS),
            KnownStage(
                "zaber",
                "Zaber, ASCII protocol",
                zaber.BAUD_RATES,
                zaber.open_zaber,
                True,
                MappingProxyType({"microstep": 1e-3}),
                zaber.OPTIONS,
            ),
            KnownStage("encoder", "an encoder read by the scanner", (), lambda setup: EncoderOnScanner(), False),
            KnownStage(
                "constant_speed",
                "a conveyor of constant speed",
                (),
                ConstantSpeed,
                False,
                options=CONSTANT_SPEED_OPTIONS,
            ),
        )
    }
)


def stage_names() -> list[str]:
    """Return the names of all stages, the added ones included."""
    return sorted({*KNOWN, *added(STAGES_GROUP)})


def known_stage(name: str) -> KnownStage:
    """Return the kind of that name.

    Raises
    ------
    DriverUnknown : there is none, or an added one cannot be loaded.
    """
    if name in KNOWN:
        return KNOWN[name]
    found = find_added(STAGES_GROUP, name, KnownStage)
    if found is None:
        raise DriverUnknown(f"there is no stage {name!r}; the stages are {', '.join(stage_names())}")
    return found


@dataclass(frozen=True, slots=True)
class FoundStage:
    """What answered on a port: the kind of stage, the rate it answered at and what it said of itself."""

    stage: KnownStage
    baud_rate: int
    identity: str


def identify_stage(
    path: str, names: Iterable[str] | None = None, baud_rates: Iterable[int] | None = None, patience_s: float = 3.0
) -> FoundStage | None:
    """Try the stages of these names (all of ours) at their rates (or at these); return the first that answers.

    Nothing is moved and nothing left running; a motion that another program began is ended.

    Raises
    ------
    PortError : when the port itself cannot be used; another rate or kind would not help.
    """
    rates = None if baud_rates is None else tuple(baud_rates)
    for name in KNOWN if names is None else names:
        known = known_stage(name)
        options = complete_options(name, known.options, known.probe_options)
        for rate in known.baud_rates if rates is None or not known.baud_rates else rates:
            stage = known.opens(StageSetup(path, rate, options=options, patience_s=patience_s))
            try:
                return FoundStage(known, rate, stage.enter().identity)
            except PortError:
                raise
            except StageError:
                continue
            finally:
                stage.exit()
    return None


def open_stage(description: RigDescription) -> Stage:
    """Return a driver for the stage of a rig, not yet entered.

    Raises
    ------
    DriverUnknown : there is no such kind.
    DriverError : an option is wrong or missing.
    """
    choice = description.stage
    known = known_stage(choice.kind)
    return known.opens(
        StageSetup(
            choice.port or "",
            choice.baud_rate or (known.baud_rates[0] if known.baud_rates else 0),
            description.limits.travel_mm,
            description.limits.speed_mm_per_s,
            description.mm_per_unit,
            complete_options(f"stage {choice.kind}", known.options, choice.options),
        )
    )
