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
|   |-- ScannerNotConnected     a command was given while no device is there
|   `-- ProtocolUnsupported     the device speaks another version of the protocol
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


class ScannerNotConnected(ScannerError):
    """A command was given while no device is there."""


class ProtocolUnsupported(ScannerError):
    """The device speaks another version of the protocol."""


class PositionUnknown(DriverError):
    """A profile cannot be placed on the part without its stage position."""
