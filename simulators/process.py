"""A simulated scanner as its own process: puts part, optics, device and port together; the simulators' only wiring.

A parent talks to it in lines: it prints one JSON object a line, and takes one command a line (`unplug`, `replug`,
`reboot`, `stop`) when its standard input is a pipe. When that pipe closes the parent is gone, and the process ends.
"""

import argparse
import contextlib
import json
import os
import secrets
import select
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from drivers.scanline import DeviceInfo, Float64Array, Pose
from simulators.devices.native import NativeDevice
from simulators.faults import Faults
from simulators.known import DEFAULT_SPEED_MM_PER_S, KNOWN_DEVICES, KnownDevice, PassingPart
from simulators.meshes import MeshError
from simulators.optics import LaserLineScanner, demo_scanner
from simulators.parts import PARTS, Part, mesh_part
from simulators.pty_port import PtyPort, SimulatedPortError, UnknownDevice
from simulators.turntable import (
    ENCODER_MM_PER_COUNT,
    STAGE_BAUD_RATE,
    Table,
    rig_text,
    turned_part,
    turned_scene,
)

DEFAULT_BAUD_RATE = 3_000_000
"""Of the native device; the others begin at the rate that their originals have when they are switched on."""
STAGE_MM = (-100.0, 400.0)
BUFFER_BYTES = 262_144
"""Larger than a real scanner's: the simulator shares a computer with its client, and a pause of the computer of up to
0.8 s at the default rate must not look like a slow wire."""
TURN_BUFFER_BYTES = 8_388_608
"""A whole turn in fine lines: the table turns on, however long the computer does not listen to the scanner."""
PATIENT_DEAD_MAN_S = 5.0
"""Longer than a real scanner's, for the same reason: no laser is on, and a busy computer is no host that is gone."""
_LOOK_S = 0.1

Event = dict[str, object]


class Scene:
    """What the sensor sees of a surface from each stage position: the `scene_line` that a device asks."""

    def __init__(
        self,
        scanner: LaserLineScanner,
        part: Part,
        rng: np.random.Generator,
        part_from_sensor: Pose | None = None,
        travel: tuple[float, float, float] = (0.0, 1.0, 0.0),
    ) -> None:
        self._scanner = scanner
        self._surface = part.surface
        self._rng = rng
        self._mounting = part_from_sensor or Pose.identity()
        self._travel = np.array(travel)

    def __call__(self, stage_mm: float) -> tuple[Float64Array, Float64Array]:
        """x and z (n,) in the sensor frame, NaN = no return, with the stage at `stage_mm`."""
        moved = Pose(self._mounting.rotation.copy(), self._mounting.translation_mm + stage_mm * self._travel)
        return self._scanner.expose(self._surface, moved, self._rng)


def simulated_device(
    part: Part,
    rng: np.random.Generator,
    *,
    scanner: LaserLineScanner | None = None,
    device_id: str = "SIM-0001",
    boot_id: int | None = None,
    part_from_sensor: Pose | None = None,
    dead_man_s: float = PATIENT_DEAD_MAN_S,
    table: Table | None = None,
) -> NativeDevice:
    """A scanner over `part` that speaks the native protocol.

    `part_from_sensor` is its mounting with the stage at 0 (identity: stage position and part y are the same); the stage
    travels along the part's y. With a `table` the part turns before it instead, and it reads the table's encoder. A
    boot id is drawn anew when none is given, since no two boots may share one.
    """
    optics = scanner or demo_scanner()
    scene_rng, device_rng = rng.spawn(2)
    info = DeviceInfo(
        device_id=device_id,
        model="Simulated laser-line scanner",
        firmware="simulator 1",
        calibration_id=f"{device_id}-A",
        boot_id=secrets.randbits(32) if boot_id is None else boot_id,
        points_per_line=optics.points_per_line,
        geometry=optics.geometry(),
    )
    if table is not None:
        return NativeDevice(
            info,
            turned_scene(optics, part, scene_rng),
            rng=device_rng,
            buffer_bytes=TURN_BUFFER_BYTES,
            encoder_mm_per_count=ENCODER_MM_PER_COUNT,
            encoder_mm=table.encoder_mm,
            dead_man_s=dead_man_s,
        )
    scene = Scene(optics, part, scene_rng, part_from_sensor)
    return NativeDevice(
        info, scene, rng=device_rng, travel_mm=STAGE_MM, buffer_bytes=BUFFER_BYTES, dead_man_s=dead_man_s
    )


def serve_simulated_scanner(
    part: Part,
    *,
    stop: threading.Event,
    announce: Callable[[Event], None],
    kind: str = "native",
    baud_rate: int | None = None,
    speed_mm_per_s: float = DEFAULT_SPEED_MM_PER_S,
    seed: int = 1,
    link_path: Path | None = None,
    faults: Faults | None = None,
    device_id: str = "SIM-0001",
    boot_id: int | None = None,
    dead_man_s: float = PATIENT_DEAD_MAN_S,
    turntable: bool = False,
    rig_file: Path | None = None,
    commands: int | None = None,
) -> None:
    """Serve a simulated scanner in the calling thread until `stop` is set, or until `commands` ends or says so.

    Parameters
    ----------
    part : what lies under the scanner.
    announce : told of the port to open before anything else, then of every command carried out.
    kind : `native`, which has a stage of its own, or one of `KNOWN_DEVICES`, under which the part passes at
        `speed_mm_per_s`.
    baud_rate : of the wire where the device does not set it itself: `native`.
    seed : of the noise, the dropouts and the faults.
    link_path : a symbolic link that always names the present terminal.
    dead_man_s : how long the native device scans on without a word of its host.
    turntable : the part stands on a turntable with a terminal of its own, and the native scanner reads its encoder.
    rig_file : written once the terminals are there: the rig file that puts scanner and turntable together.
    commands : a file descriptor with one command a line; None: there are none.

    Raises
    ------
    simulators.pty_port.SimulatedPortError : when the link cannot be made, or the device failed.
    """
    scene_rng, wire_rng = np.random.default_rng(seed).spawn(2)
    actions: dict[str, Callable[[], None]] = {}
    extras: Event = {"travel_mm": list(part.travel_mm), "part": part.description, "seed": seed}
    table, stage_port = None, None
    if turntable:
        if kind != "native":
            raise UnknownDevice(f"{kind} reads no encoder: a turntable stands before a native scanner only")
        table = Table(time.monotonic)
        stage_port = PtyPort(table, STAGE_BAUD_RATE, clock=time.monotonic)
        actions |= {"unplug_stage": stage_port.unplug, "replug_stage": stage_port.replug, "stall": table.stall}
    if kind == "native":
        native_rate = DEFAULT_BAUD_RATE if baud_rate is None else baud_rate
        native = simulated_device(
            part, scene_rng, device_id=device_id, boot_id=boot_id, dead_man_s=dead_man_s, table=table
        )
        port = PtyPort(native, native_rate, faults, link_path=link_path, rng=wire_rng)
        actions["reboot"] = lambda: port.in_loop(native.reboot)
        extras["baud_rate"] = native_rate

        def identity() -> Event:
            return {"device_id": device_id, "boot_id": native.boot_id}
    else:
        known = _known_device(kind, baud_rate)
        device = known.makes(PassingPart(part, speed_mm_per_s, scene_rng))
        port = PtyPort(device, known.baud_rate, faults, link_path=link_path, rng=wire_rng, heeds_client_rate=True)
        extras |= {"baud_rate": known.baud_rate, "speed_mm_per_s": speed_mm_per_s}

        def identity() -> Event:
            return {"device": kind, "title": known.title}

    actions |= {"unplug": port.unplug, "replug": port.replug, "stop": stop.set}

    def event(name: str) -> Event:
        where = str(port.path) if port.is_plugged else None
        return {"event": name, "port": where} | identity()

    with port, stage_port or contextlib.nullcontext():
        # Opening a terminal throws away what waits in it: half of the greeting, if it is still on its way.
        while not (port.is_quiet or port.has_failed or stop.is_set()):
            stop.wait(0.002)
        if stage_port is not None:
            extras |= {"stage_port": str(stage_port.path), "rig_file": None if rig_file is None else str(rig_file)}
            if rig_file is not None:
                rig_file.write_text(rig_text(port.path, native_rate, stage_port.path))
        announce(event("ready") | extras)
        unread = b""
        while not (stop.is_set() or port.has_failed or (stage_port is not None and stage_port.has_failed)):
            if commands is None:
                stop.wait(_LOOK_S)
                continue
            if not select.select([commands], [], [], _LOOK_S)[0]:
                continue
            data = os.read(commands, 4096)
            if not data:
                break
            *lines, unread = (unread + data).split(b"\n")
            for line in lines:
                name = line.decode(errors="replace").strip()
                if name in actions:
                    actions[name]()
                    announce(event(name))
                else:
                    wanted = ", ".join(actions)
                    announce({"event": "refused", "reason": f"{name!r} is no command; say one of {wanted}"})


def _known_device(kind: str, baud_rate: int | None) -> KnownDevice:
    if kind not in KNOWN_DEVICES:
        raise UnknownDevice(f"there is no device {kind!r}; the devices are native, {', '.join(KNOWN_DEVICES)}")
    known = KNOWN_DEVICES[kind]
    if baud_rate is not None and baud_rate != known.baud_rate:
        raise UnknownDevice(
            f"{kind} begins at {known.baud_rate} baud, like its original, and cannot be set to {baud_rate}"
        )
    return known


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a simulated scanner as the command line says; the exit status."""
    parser = _parser()
    given = parser.parse_args(arguments)
    if given.rig_file and not given.turntable:
        parser.error("--rig-file puts a scanner and a turntable together: say --turntable too")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        serve_simulated_scanner(
            _part(given),
            stop=stop,
            announce=lambda event: print(json.dumps(event), flush=True),
            kind=given.device,
            baud_rate=given.baud,
            speed_mm_per_s=given.speed,
            seed=given.seed,
            link_path=given.link,
            faults=_faults(given),
            device_id=given.device_id,
            boot_id=given.boot_id,
            dead_man_s=given.dead_man,
            turntable=given.turntable,
            rig_file=given.rig_file,
            commands=_piped_input(),
        )
    except BrokenPipeError:
        # The parent does not listen any more. Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (SimulatedPortError, MeshError, ValueError, OSError) as error:
        print(f"simulators: {error}", file=sys.stderr)
        return 1
    return 0


def _part(given: argparse.Namespace) -> Part:
    if given.turntable:
        return turned_part()
    return mesh_part(given.mesh, given.scale) if given.mesh else PARTS[given.part]()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simulators", description="A simulated laser-line scanner on a pty."
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--part", choices=sorted(PARTS), default="demo", help="the part under the scanner")
    what.add_argument("--turntable", action="store_true", help="a part on a turntable, which has a terminal of its own")
    what.add_argument("--mesh", type=Path, metavar="FILE", help="a mesh instead: .stl, .obj or .ply")
    parser.add_argument("--rig-file", type=Path, metavar="FILE", help="write the rig file of scanner and turntable")
    parser.add_argument("--scale", type=float, default=1.0, help="millimetres in one unit of the mesh")
    parser.add_argument("--link", type=Path, metavar="PATH", help="a symbolic link that always names the terminal")
    parser.add_argument("--device", choices=["native", *KNOWN_DEVICES], default="native", help="the kind of scanner")
    parser.add_argument(
        "--speed", type=float, default=DEFAULT_SPEED_MM_PER_S, help="mm/s of the part under a scanner without a stage"
    )
    parser.add_argument("--baud", type=int, help=f"the rate of the native scanner's wire ({DEFAULT_BAUD_RATE})")
    parser.add_argument("--seed", type=int, default=1, help="of noise, dropouts and faults")
    parser.add_argument("--device-id", default="SIM-0001", help="the scanner's serial number")
    parser.add_argument("--boot-id", type=int, help="drawn anew when not given")
    parser.add_argument(
        "--dead-man", type=float, default=PATIENT_DEAD_MAN_S, help="seconds that the native scanner goes on unasked"
    )
    for item in fields(Faults):
        if item.name.endswith("_rate"):
            parser.add_argument("--" + item.name.replace("_", "-"), type=float, default=0.0, metavar="CHANCE")
    parser.add_argument("--piece-bytes", type=int, nargs=2, metavar=("SHORTEST", "LONGEST"), help="odd chunking")
    return parser


def _faults(given: argparse.Namespace) -> Faults:
    rates = {item.name: getattr(given, item.name) for item in fields(Faults) if item.name.endswith("_rate")}
    return Faults(**rates, piece_bytes=tuple(given.piece_bytes) if given.piece_bytes else None)


def _piped_input() -> int | None:
    """Standard input when a parent holds its other end; a terminal or /dev/null says nothing about a parent."""
    try:
        mode = os.fstat(0).st_mode
    except OSError:
        return None
    return 0 if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) else None
