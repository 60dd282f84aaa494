"""Stages over real pseudo-terminals: a simulated controller of each kind, and the driver for it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drivers.stages.grbl import OPTIONS as GRBL_OPTIONS
from drivers.stages.grbl import open_grbl
from drivers.stages.marlin import OPTIONS as MARLIN_OPTIONS
from drivers.stages.marlin import open_marlin
from drivers.stages.serial_stage import SerialStage
from drivers.stages.setup import StageSetup, complete_options
from drivers.stages.zaber import OPTIONS as ZABER_OPTIONS
from drivers.stages.zaber import open_zaber
from simulators.devices.grbl import GrblDevice
from simulators.devices.marlin import MarlinDevice
from simulators.devices.zaber import ZaberDevice
from simulators.pty_port import PtyPort

BAUD = 115_200
KINDS = ("grbl", "marlin", "zaber")
MICROSTEP_MM = 0.001
_MADE = {
    "grbl": (GrblDevice, open_grbl, GRBL_OPTIONS, {}),
    "marlin": (MarlinDevice, open_marlin, MARLIN_OPTIONS, {}),
    "zaber": (ZaberDevice, open_zaber, ZABER_OPTIONS, {"microstep": MICROSTEP_MM}),
}


def new_device(kind: str) -> Any:
    return _MADE[kind][0]()


def open_stage(kind: str, port: str, travel_mm: tuple[float, float] = (-300.0, 300.0), **options: Any) -> SerialStage:
    _, opens, specs, usual = _MADE[kind]
    setup = StageSetup(port, BAUD, travel_mm, (0.0, 60.0), options=complete_options(kind, specs, usual | options))
    return opens(setup)


def where_mm(kind: str, device: Any, now_s: float) -> float:
    place = device.axes.position(now_s)[0]
    return float(place * MICROSTEP_MM if kind == "zaber" else place)


def signed(kind: str, mm: float) -> float:
    """A place the axis can go to: GRBL's lie below zero."""
    return -mm if kind == "grbl" else mm


@contextlib.contextmanager
def stage_on_pty(kind: str, link: Path | None = None, **options: Any) -> Iterator[tuple[SerialStage, Any, PtyPort]]:
    device = new_device(kind)
    with PtyPort(device, BAUD, link_path=link) as port, open_stage(kind, str(port.path), **options) as stage:
        yield stage, device, port
