"""What a session keeps of the scanner that took it, and reads when it is reopened; knows no port."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from drivers.scanline import Float64Array, SensorGeometry
from scanner_service.sessions.source import OnAWire, Source
from scanner_service.storage.rows import EventRow


def calibration_of(source: Source) -> dict[str, Any]:
    """Optics, mounting and identity as a JSON object; empty for a source that knows none of them."""
    kept: dict[str, Any] = {}
    if isinstance(source, OnAWire):
        info = source.info
        kept["scanner"] = {
            "device_id": info.device_id,
            "model": info.model,
            "firmware": info.firmware,
            "calibration_id": info.calibration_id,
            "boot_id": info.boot_id,
            "points_per_line": info.points_per_line,
        }
    if source.geometry is not None:
        kept["geometry"] = {name: _plain(value) for name, value in asdict(source.geometry).items()}
    if source.towards_sensor is not None:
        kept["towards_sensor"] = source.towards_sensor.tolist()
    return kept


def geometry_from(kept: Mapping[str, Any]) -> SensorGeometry | None:
    """The optics that `calibration_of` kept; None when there are none, or they are of another version."""
    told = kept.get("geometry")
    try:
        return None if told is None else SensorGeometry(**{name: _array(value) for name, value in told.items()})
    except (TypeError, ValueError):
        return None


def towards_sensor_from(kept: Mapping[str, Any]) -> Float64Array | None:
    """The direction towards the sensor that `calibration_of` kept, (3,); None when there is none."""
    told = kept.get("towards_sensor")
    return None if told is None else np.array(told, dtype=np.float64)


CALIBRATED = "calibrated"
"""The event before a further pass of a session: what `calibration_of` says from here on."""


def calibration_after(
    kept: Mapping[str, Any], events: Iterable[EventRow], lines: int | None = None
) -> Mapping[str, Any]:
    """The calibration in force after so many lines of a session (None: all), of which `kept` is the first."""
    told = [
        event.details
        for event in events
        if event.kind == CALIBRATED and not event.damaged and (lines is None or event.line_number < max(lines, 1))
    ]
    return told[-1] if told else kept


def _plain(value: Any) -> Any:
    return {"array": value.tolist()} if isinstance(value, np.ndarray) else value


def _array(value: Any) -> Any:
    if isinstance(value, dict):
        return np.array(value["array"], dtype=np.float64)
    return tuple(value) if isinstance(value, list) else value
