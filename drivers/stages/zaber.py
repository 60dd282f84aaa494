"""A stage with Zaber's ASCII protocol: its options, and the conversation that moves it."""

from types import MappingProxyType

from drivers.errors import DriverError
from drivers.protocols.zaber_host import ZaberHost
from drivers.stages.serial_stage import SerialStage
from drivers.stages.setup import OptionSpec, StageSetup

BAUD_RATES = (115_200, 9_600, 57_600, 38_400, 19_200)
OPTIONS = MappingProxyType(
    {
        "microstep": OptionSpec(0.0, "mm (or degrees) of one microstep, from the data sheet; it must be given"),
        "device": OptionSpec(1, "number in the chain"),
        "axis": OptionSpec(1, "number of the axis in the device"),
        "tolerance": OptionSpec(0.002, "how far from its target the axis may come to rest, in mm or degrees"),
    }
)


def open_zaber(setup: StageSetup) -> SerialStage:
    """Return a stage that is not yet entered; raises DriverError when the microstep is not given."""
    microstep, tolerance = setup.number("microstep"), setup.number("tolerance")
    device, axis = int(setup.number("device")), int(setup.number("axis"))
    if not microstep > 0:
        raise DriverError("zaber needs options.microstep: the mm (or degrees) of one microstep, from its data sheet")
    if not (1 <= device <= 99 and 1 <= axis <= 9):
        raise DriverError(f"a Zaber chain has devices 1 to 99 with axes 1 to 9, not device {device}, axis {axis}")
    return SerialStage(
        lambda on_reading, on_event: ZaberHost(on_reading, on_event, microstep, device, axis, tolerance),
        setup.port_name,
        setup.baud_rate or BAUD_RATES[0],
        travel_mm=setup.travel_mm,
        speed_mm_per_s=setup.speed_mm_per_s,
        mm_per_unit=setup.mm_per_unit,
        clock=setup.clock,
        patience_s=setup.patience_s,
    )
