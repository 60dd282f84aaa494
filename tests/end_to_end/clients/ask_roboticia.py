"""rplidar-roboticia on a lidar on a pseudo-terminal: what it makes of it, as a line of JSON."""

import itertools
import json
import sys

import without_modem_lines
from rplidar import RPLidar

without_modem_lines.allow()
lidar = RPLidar(sys.argv[1], baudrate=int(sys.argv[2]))
found = {"info": lidar.get_info(), "health": lidar.get_health()}
for kind in ("normal", "express"):
    measures = itertools.islice(lidar.iter_measures(kind), 1500)
    found[kind] = [[bool(new), angle, distance] for new, _, angle, distance in measures]
    lidar.stop()
lidar.stop_motor()
lidar.disconnect()
print(json.dumps(found))
