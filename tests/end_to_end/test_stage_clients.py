"""Other people's programs against our simulated controllers, over real pseudo-terminals.

They are tools of the tests only; where one is not installed its test is skipped, and says how to get it.
"""

import importlib
import time

import pytest

from simulators.devices.grbl import GrblDevice
from simulators.devices.marlin import MarlinDevice
from simulators.devices.zaber import ZaberDevice
from simulators.pty_port import PtyPort
from tests.end_to_end.running import wait_for

BAUD = 115_200


def client(module, package):
    try:
        return importlib.import_module(module)
    except ImportError as error:
        pytest.skip(f"{package} is not installed ({error}): pip install {package}")


def test_grbl_streamer_unlocks_and_streams_by_counting_characters():
    grbl_streamer = client("grbl_streamer", "grbl-streamer")
    device = GrblDevice()
    told = []
    with PtyPort(device, BAUD) as port:
        streamer = grbl_streamer.GrblStreamer(lambda event, *data: told.append(event))
        streamer.setup_logging()
        streamer.cnect(str(port.path), BAUD)
        try:
            wait_for(lambda: "on_boot" in told, "grbl-streamer to see the banner")
            streamer.killalarm()
            wait_for(lambda: device.state == "Idle", "the controller to be unlocked")
            time.sleep(1.0)  # its own count goes astray when a job begins before it has read the answer to `$X`
            streamer.incremental_streaming = False
            lines = [f"G1 X{-0.5 * n:.3f} Y{-0.25 * n:.3f} F6000" for n in range(1, 81)]
            streamer.write("\n".join(["G21 G90", *lines]))
            streamer.job_run()
            wait_for(lambda: device.axes.position(time.monotonic())[:2] == (-40.0, -20.0), "the axes to arrive")
            streamer.poll_start()  # not earlier: it asks for $G without counting those characters
            wait_for(lambda: streamer.cmpos[0] == -40.0, "grbl-streamer to have read the position")
        finally:
            streamer.disconnect()
    assert device.axes.position(time.monotonic())[:2] == (-40.0, -20.0)
    assert device.lost_characters == 0
    assert "on_error" not in told
    assert "on_alarm" not in told


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_printrun_numbers_and_checks_its_lines_and_sends_damaged_ones_again():
    printcore = client("printrun.printcore", "printrun")
    device = MarlinDevice()
    damaged = []
    take = device.receive

    def sometimes_damaged(data, now_s):
        if b"X33" in data and not damaged:
            damaged.append(data)
            data = data.replace(b"X33", b"X39")
        take(data, now_s)

    device.receive = sometimes_damaged
    with PtyPort(device, BAUD) as port:
        printer = printcore.printcore()
        printer.loud = False
        printer.connect(str(port.path), BAUD)
        try:
            wait_for(lambda: printer.online, "printrun to be online")
            layers = importlib.import_module("printrun.gcoder")
            program = layers.LightGCode(["G90", *[f"G1 X{n} F12000" for n in range(1, 51)]])
            assert printer.startprint(program)
            wait_for(lambda: not printer.printing, "printrun to finish")
            wait_for(lambda: device.axes.position(time.monotonic())[0] == 50.0, "the axes to arrive")
        finally:
            printer.disconnect()
    assert len(damaged) == 1
    assert device.resends == 1


def test_zaber_motion_homes_and_moves_the_axis():
    zaber = client("zaber_motion.ascii", "zaber-motion")
    device = ZaberDevice(limit_max=300_000)
    with PtyPort(device, BAUD) as port, zaber.Connection.open_serial_port(str(port.path), BAUD) as connection:
        connection.enable_alerts()
        axis = connection.get_device(1).get_axis(1)
        axis.home()
        assert device.flags == []
        axis.move_absolute(12_345)
        assert round(device.axes.position(time.monotonic())[0]) == 12_345
        assert axis.get_position() == 12_345
        axis.move_relative(-345, wait_until_idle=False)
        axis.wait_until_idle()
        assert axis.get_position() == 12_000
        axis.move_absolute(250_000, wait_until_idle=False)
        assert axis.is_busy()
        axis.stop()
        assert not device.axes.is_moving(time.monotonic())
        answer = connection.generic_command("get system.serial", device=1)
        assert answer.data == "12345"
        assert device.damaged_lines == 0
