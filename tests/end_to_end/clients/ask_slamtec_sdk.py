"""Slamtec's own SDK on a lidar on a pseudo-terminal: what it makes of it, as a line of JSON at the end."""

import json
import sys

import pyrplidarsdk

lidar = pyrplidarsdk.RplidarDriver(port=sys.argv[1], baudrate=int(sys.argv[2]))
assert lidar.connect()
info, health = lidar.get_device_info(), lidar.get_health()
assert lidar.start_scan()
scans = [lidar.get_scan_data() for _ in range(int(sys.argv[3]))]
lidar.stop_scan()
lidar.disconnect()
found = {
    "info": [info.model, info.firmware_version, info.hardware_version, info.serial_number],
    "health": [str(health.status), health.error_code],
    "scans": [[list(column) for column in scan] for scan in scans if scan is not None],
}
print(json.dumps(found))
