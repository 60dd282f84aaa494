"""pyrplidar on a lidar on a pseudo-terminal: what it makes of it, as a line of JSON at the end."""

import itertools
import json
import sys
import time

import without_modem_lines
from pyrplidar import PyRPlidar

without_modem_lines.allow()
lidar = PyRPlidar()
lidar.connect(port=sys.argv[1], baudrate=int(sys.argv[2]), timeout=3)
info, health, rate = lidar.get_info(), lidar.get_health(), lidar.get_samplerate()
count, typical = lidar.get_scan_mode_count(), lidar.get_scan_mode_typical()
modes = [[mode.name, mode.ans_type, mode.us_per_sample] for mode in lidar.get_scan_modes()]
lidar.set_motor_pwm(660)
scan = lidar.start_scan_express(typical)
express = [[m.start_flag, m.angle, m.distance] for m in itertools.islice(scan(), 2000)]
lidar.stop()
time.sleep(0.3)
lidar.lidar_serial._serial.reset_input_buffer()
scan = lidar.force_scan()
standard = [[m.start_flag, m.angle, m.distance] for m in itertools.islice(scan(), 400)]
lidar.stop()
lidar.set_motor_pwm(0)
lidar.disconnect()
found = {
    "info": [info.model, info.firmware_major, info.firmware_minor, info.hardware, info.serialnumber],
    "health": [health.status, health.error_code],
    "rate": [rate.t_standard, rate.t_express],
    "modes": modes,
    "count": count,
    "typical": typical,
    "express": express,
    "standard": standard,
}
print(json.dumps(found))
