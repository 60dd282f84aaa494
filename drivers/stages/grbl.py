"""A stage on a GRBL 1.1 controller: its options, and the conversation that moves it."""

from types import MappingProxyType

from drivers.protocols.grbl import AXES
from drivers.protocols.grbl_host import GrblHost
from drivers.stages.serial_stage import SerialStage
from drivers.stages.setup import DTR, DTR_LINES, OptionSpec, StageSetup

BAUD_RATES = (115_200, 250_000, 9_600)
OPTIONS = MappingProxyType(
    {
        "letter": OptionSpec("X", "letter of the axis", tuple(AXES)),
        "tolerance": OptionSpec(0.01, "how far from its target the axis may come to rest, in its own unit"),
        "dtr": DTR,
    }
)


def open_grbl(setup: StageSetup) -> SerialStage:
    """Return a stage that is not yet entered."""
    letter, tolerance = setup.text("letter"), setup.number("tolerance")
    return SerialStage(
        lambda on_reading, on_event: GrblHost(on_reading, on_event, letter, tolerance),
        setup.port_name,
        setup.baud_rate or BAUD_RATES[0],
        travel_mm=setup.travel_mm,
        speed_mm_per_s=setup.speed_mm_per_s,
        mm_per_unit=setup.mm_per_unit,
        lines=DTR_LINES[setup.flag("dtr")],
        clock=setup.clock,
        patience_s=setup.patience_s,
    )
