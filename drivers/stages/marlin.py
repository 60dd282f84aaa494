"""A stage on a Marlin controller: its options, and the conversation that moves it."""

from types import MappingProxyType

from drivers.protocols.marlin_host import MarlinHost
from drivers.stages.serial_stage import SerialStage
from drivers.stages.setup import DTR, DTR_LINES, OptionSpec, StageSetup

BAUD_RATES = (115_200, 250_000)
OPTIONS = MappingProxyType(
    {
        "letter": OptionSpec("X", "letter of the axis", tuple("XYZABCUVW")),
        "steps_per_unit": OptionSpec(0.0, "steps per mm or degree, where the firmware does not answer M92; 0 asks it"),
        "tolerance": OptionSpec(0.02, "how far from its target the axis may come to rest, in its own unit"),
        "dtr": DTR,
    }
)


def open_marlin(setup: StageSetup) -> SerialStage:
    """Return a stage that is not yet entered."""
    letter, steps, tolerance = setup.text("letter"), setup.number("steps_per_unit"), setup.number("tolerance")
    return SerialStage(
        lambda on_reading, on_event: MarlinHost(on_reading, on_event, letter, steps, tolerance),
        setup.port_name,
        setup.baud_rate or BAUD_RATES[0],
        travel_mm=setup.travel_mm,
        speed_mm_per_s=setup.speed_mm_per_s,
        mm_per_unit=setup.mm_per_unit,
        lines=DTR_LINES[setup.flag("dtr")],
        clock=setup.clock,
        patience_s=setup.patience_s,
    )
