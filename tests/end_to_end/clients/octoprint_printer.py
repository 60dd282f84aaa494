"""OctoPrint's virtual Marlin printer behind a pseudo-terminal; run by an interpreter that has OctoPrint installed.

Its settings are its own defaults, but for two: M114 is written as Marlin's own source writes it, with step counts by
the letters of the axes, and its scripted errors are those that the arguments name, `LINE:ERROR` each. It prints the
terminal to open, then serves until it is ended.
"""

import contextlib
import os
import select
import sys
import tempfile
import threading
import tty

from octoprint.plugin import plugin_manager
from octoprint.plugins.virtual_printer import VirtualPrinterPlugin
from octoprint.plugins.virtual_printer.virtual import VirtualPrinter
from serial import SerialTimeoutException

M114 = "X:{x:.2f} Y:{y:.2f} Z:{z:.2f} E:{e[current]:.2f} Count X:{a} Y:{b} Z:{c}"


class Settings:
    """The plug-in's defaults, asked as OctoPrint asks them."""

    def __init__(self, folder):
        self._values = VirtualPrinterPlugin().get_settings_defaults()
        self._values.update(m114FormatString=M114, simulated_errors=sys.argv[1:], throttle=0.0)
        self._folder = folder

    def get(self, path, **_):
        value = self._values
        for key in path:
            value = value[key]
        return value

    def get_boolean(self, path, **_):
        return bool(self.get(path))

    def get_int(self, path, **_):
        return int(self.get(path))

    def get_float(self, path, **_):
        return float(self.get(path))

    def global_get_basefolder(self, _name):
        return self._folder


class Profiles:
    """One printer with one nozzle."""

    def get_current_or_default(self):
        return {"extruder": {"count": 1}, "heatedBed": True, "volume": {"width": 200, "depth": 200, "height": 200}}


def main():
    plugin_manager(init=True, plugin_folders=[], plugin_entry_points=[])
    with tempfile.TemporaryDirectory() as folder:
        printer = VirtualPrinter(Settings(folder), Profiles(), data_folder=folder, read_timeout=0.1)
        master, slave = os.openpty()
        tty.setraw(master)
        tty.setraw(slave)
        print(os.ttyname(slave), flush=True)

        def speak():
            while True:
                line = printer.readline()
                if line:
                    os.write(master, line if line.endswith(b"\n") else line + b"\n")

        threading.Thread(target=speak, daemon=True).start()
        heard = bytearray()
        while True:
            if not select.select([master], [], [], 1.0)[0]:
                continue
            heard += os.read(master, 4096)
            *lines, rest = bytes(heard).split(b"\n")
            heard = bytearray(rest)
            for line in lines:
                waiting = line + b"\n"
                while waiting:
                    with contextlib.suppress(SerialTimeoutException):  # its buffer is full: real ones have flow control
                        waiting = waiting[printer.write(waiting) :]


main()
