"""hokuyolx on a lidar behind a TCP port: what it makes of it, as a line of JSON."""

import json
import sys

from hokuyolx import HokuyoLX

lidar = HokuyoLX(addr=("127.0.0.1", int(sys.argv[1])), tsync=False, convert_time=False)
timestamp, single = lidar.get_dist()
scans = [measured[0].tolist() for measured in lidar.iter_dist(3)]
lidar.standby()
version = lidar.version()
lidar.close()
print(
    json.dumps(
        {
            "model": lidar.model,
            "steps": [lidar.amin, lidar.amax, lidar.aforw, lidar.ares],
            "serial": version["SERI"],
            "timestamp": timestamp,
            "single": single.tolist(),
            "scans": scans,
        }
    )
)
