"""The one tree of errors of this package; line noise is data and never one of them.

DriverError
|-- PortError                   the tty itself; `path` is the one that was asked for
|   |-- PortAbsent              no such device file, or its adapter is gone
|   |-- PortBusy                another program holds it
|   |-- PortNotPermitted        the user may not open it
|   |-- PortNotSerial           the path is not a serial device
|   |-- PortRateRefused         the device does not do this baud rate
|   |-- PortLost                pulled out while open
|   `-- PortStalled             takes no more bytes
|-- ScannerError                the device behind the tty
|   |-- ScannerSilent           nothing intelligible answers
|   |-- ScannerTimeout          a command was not acknowledged
|   |-- ScannerRefused          a command was refused, with the reason
|   |   `-- PassRefused         a pass that it cannot drive; asking again does not help
|   |-- ScannerNotConnected     a command was given while no device is there
|   `-- ProtocolUnsupported     the device speaks another version of the protocol
|-- StageError                  what moves, behind its tty
|   |-- StageSilent             nothing intelligible answers
|   |-- StageTimeout            a command was not acknowledged
|   |-- StageRefused            the controller refused a command, with the reason
|   |-- StageAlarm              the controller has locked itself
|   |-- StageStopped            a motion was ended by a stop
|   |-- StageNotConnected       a command was given while no controller is there
|   |-- StageLimit              a target outside the soft limits; nothing was sent
|   `-- StagePositionUnknown    a motion was asked for before homing; nothing was sent
|-- RigInvalid                  a rig file that cannot be meant; `problems` names all of them
|-- DriverUnknown               no driver of that name is installed
`-- PositionUnknown             a profile cannot be placed without its stage position
"""


class DriverError(Exception):
    """Anything that went wrong between a scanline and the device that should have measured it."""


class PortError(DriverError):
    """Something is wrong with the tty at `path`."""

    def __init__(self, path: str, message: str) -> None:
        super().__init__(message)
        self.path = path


class PortAbsent(PortError):
    """There is no such device file, or its adapter has gone."""


class PortBusy(PortError):
    """Another program holds the port."""


class PortNotPermitted(PortError):
    """This user may not open the port."""


class PortNotSerial(PortError):
    """The path does not lead to a serial device."""


class PortRateRefused(PortError):
    """The serial device does not do this baud rate."""


class PortLost(PortError):
    """The port was pulled out, or hung up, while it was open."""


class PortStalled(PortError):
    """The port takes no more bytes."""


class ScannerError(DriverError):
    """Something is wrong with the device behind the tty."""


class ScannerSilent(ScannerError):
    """Nothing intelligible answers."""


class ScannerTimeout(ScannerError):
    """A command was not acknowledged in time."""


class ScannerRefused(ScannerError):
    """The device refused a command; the message says why."""


class PassRefused(ScannerRefused):
    """The device cannot drive the pass as it was ordered; asking for the same once more does not help."""


class ScannerNotConnected(ScannerError):
    """A command was given while no device is there."""


class ProtocolUnsupported(ScannerError):
    """The device speaks another version of the protocol."""


class PositionUnknown(DriverError):
    """A profile cannot be placed on the part without its stage position."""


class StageError(DriverError):
    """Something is wrong with what moves, or with its controller."""


class StageSilent(StageError):
    """Nothing intelligible answers."""


class StageTimeout(StageError):
    """A command was not acknowledged in time."""


class StageRefused(StageError):
    """The controller refused a command; the message says why."""


class StageAlarm(StageError):
    """The controller has locked itself; the message says why, and what frees it."""


class StageStopped(StageError):
    """A motion was ended by a stop before its target."""


class StageNotConnected(StageError):
    """A command was given while no controller is there."""


class StageLimit(StageError):
    """A target outside the soft limits; nothing was sent."""


class StagePositionUnknown(StageError):
    """A motion was asked for while the position is unknown; nothing was sent."""


class RigInvalid(DriverError):
    """A rig file that cannot be meant; `problems` holds one sentence for each thing that is wrong."""

    def __init__(self, source: str, problems: tuple[str, ...]) -> None:
        self.source = source
        self.problems = problems
        listed = problems[0] if len(problems) == 1 else "".join(f"\n  - {problem}" for problem in problems)
        super().__init__(f"{source}: {listed}")


class DriverUnknown(DriverError):
    """No driver of that name is installed."""
