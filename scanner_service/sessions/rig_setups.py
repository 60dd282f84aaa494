"""What a session's rig can do, taken from its source, and how a pass is started on it; plans nothing, keeps no order.

A device scans along its own stage; the rig of a rig file along its axis or around its table; everything else is moved
by a hand or by a client, and has to be described first.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import PortBusy, ScannerSilent
from drivers.rig import Rig
from drivers.rig_description import RigDescription
from drivers.rig_file import read_rig
from drivers.rig_limits import AxisKind, PassOrder, RigLimits
from drivers.running_rig import RunningRig
from drivers.scanline import Pose, SensorGeometry
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.errors import OpticsUnknown, RigUnlimited
from scanner_service.rescan.passes.fan import measured_optics
from scanner_service.rescan.passes.motion import Motion, StraightMotion, TurningMotion
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.passes.recommendation import RecommendedPass
from scanner_service.sessions.errors import SessionBusy, SourceUnusable
from scanner_service.sessions.rig_source import Preparation, RigSource
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.source import Source
from scanner_service.sessions.source_specs import DeviceSpec
from scanner_service.sessions.still_sources import PushSource

_LOG = logging.getLogger(__name__)
_DRIVING = StraightMotion(Pose.identity(), np.array([0.0, 1.0, 0.0]))  # the default rig: part = (x, position, z)


@dataclass(frozen=True, slots=True)
class RigSetup:
    """What a session's rig can do, and what its scanner can see.

    `scanned_by` is how the session's own first pass was driven, None where nobody knows. `driven_by_client`: a client
    of the service carries out what was accepted, by itself.
    """

    reach: Reach
    optics: ScannerOptics
    scanned_by: Motion | None = None
    driven_by_client: bool = False


def setup_of(session: LiveSession, snapshot: MapSnapshot, rigs: Path | None) -> RigSetup:
    """The setup of a session whose source knows its rig.

    Raises
    ------
    RigUnlimited : the source is none that the service can drive, or the rig's limits are not known.
    OpticsUnknown : the scanner's field of view can be neither measured nor read.
    """
    match session.row.source.get("kind"):
        case "device":
            return _device_setup(session, snapshot)
        case "rig":
            return _rig_setup(session, snapshot, rigs)
    raise RigUnlimited(
        "the service does not know what this session's rig can do: state its limits and the scanner's optics "
        "(PUT .../rig) before passes are planned"
    )


def is_driven(session: LiveSession) -> bool:
    """True when the service itself can move the scanner of the session."""
    if isinstance(session.source, RigSource):
        return session.source.is_driven
    return session.row.source.get("kind") in ("device", "rig")


def start_pass(session: LiveSession, wanted: RecommendedPass, rigs: Path | None) -> None:
    """Start the pass on the session's own device or rig, or make the session take pushed lines again.

    Raises
    ------
    SessionBusy : the session's source cannot be driven, or is in another state.
    SourceUnusable, DriverError : the pass could not be started; nothing moves.
    """
    if isinstance(session.source, PushSource):
        session.start()
        return
    match session.row.source.get("kind"):
        case "device" if isinstance(wanted.motion, StraightMotion):
            session.carry_out(_device_opener(session, wanted, wanted.motion))
        case "rig":
            session.carry_out(_rig_opener(session, wanted, rigs))
        case _:
            raise SessionBusy(
                "this session's source cannot be driven: scan the pass by hand into a session of pushed lines"
            )


def optics_stated(
    geometry: SensorGeometry, field_of_view_mm: float, rays: int, max_incidence_rad: float, middle_mm: float = 0.0
) -> ScannerOptics:
    """Optics as a user states them; raises OpticsUnknown when they cannot be."""
    if not 0 < max_incidence_rad < 0.5 * np.pi:
        raise OpticsUnknown("the largest incidence must lie between 0° and 90°")
    return ScannerOptics(geometry, field_of_view_mm, rays, middle_mm, max_incidence_rad)


# -- a device on its own stage --------------------------------------------------------------------------------------


def _device_setup(session: LiveSession, snapshot: MapSnapshot) -> RigSetup:
    """The travel and the rate at which the session scanned; the field of view as its points show it."""
    geometry, rays = _scanner_of(session)
    known = session.row.source
    rate, start, end = float(known["line_rate_hz"]), float(known["start_mm"]), float(known["end_mm"])
    optics = measured_optics(snapshot, geometry, _DRIVING, rays)
    half = 0.5 * optics.field_of_view_mm
    limits = RigLimits(
        AxisKind.LINEAR,
        (min(start, end), max(start, end)),
        (0.0, rate * float(known["line_spacing_mm"])),
        (0.0, rate),
        geometry,
        (optics.middle_mm - half, optics.middle_mm + half),
    )
    return RigSetup(Reach(limits), optics, _DRIVING)


def _scanner_of(session: LiveSession) -> tuple[SensorGeometry, int]:
    """Optics and points a line, of the source, or as the record kept them."""
    geometry = session.source.geometry
    info = getattr(session.source, "info", None)
    told = session.row.calibration.get("scanner") or {}
    rays = info.points_per_line if info is not None else int(told.get("points_per_line", 0))
    if geometry is None or rays < 2:
        raise OpticsUnknown(
            "the scanner's optics are not known: state them with the rig's limits (PUT .../rig) before passes are "
            "planned"
        )
    return geometry, rays


def _device_opener(session: LiveSession, wanted: RecommendedPass, motion: StraightMotion) -> Callable[[], Source]:
    known = dict(session.row.source)
    known.pop("kind")
    spec = replace(
        DeviceSpec(**known),
        line_spacing_mm=wanted.line_spacing_mm,
        start_mm=wanted.start_mm,
        end_mm=wanted.end_mm,
        line_rate_hz=wanted.line_rate_hz,
    )
    rig = Rig(stage_from_sensor=motion.at_zero, travel_stage=motion.travel.copy())
    return lambda: _patiently(lambda: spec.open(rig))


# -- the rig of a rig file ------------------------------------------------------------------------------------------


def _rig_setup(session: LiveSession, snapshot: MapSnapshot, rigs: Path | None) -> RigSetup:
    description = _description_of(session, rigs)
    geometry, rays = _scanner_of(session)
    limits, rig = replace(description.limits, geometry=geometry), description.rig()
    finest, coarsest = limits.line_spacing_mm
    reach = Reach(limits, rig, line_spacing_mm=(max(finest, 0.05), max(min(coarsest, 1.0), finest, 0.05)))
    motion = _motion_of(rig)
    try:
        optics = measured_optics(snapshot, geometry, motion, rays)
    except OpticsUnknown:
        low, high = limits.field_of_view_mm
        if not (math.isfinite(low) and math.isfinite(high)):
            raise
        optics = ScannerOptics(geometry, high - low, rays, 0.5 * (low + high))
    return RigSetup(reach, optics, motion)


def _motion_of(rig: Rig) -> Motion:
    """How the sensor goes, seen from the part."""
    if rig.turntable is not None:
        axis = rig.part_from_stage.rotate(rig.turntable.axis_stage)
        return TurningMotion(rig.part_from_sensor(0.0), axis, rig.turntable.radius_mm)
    return StraightMotion(rig.part_from_sensor(0.0), rig.part_from_stage.rotate(rig.travel_stage))


def _description_of(session: LiveSession, rigs: Path | None) -> RigDescription:
    """The rig as it was read when the session was made, else as its file says now."""
    if isinstance(session.source, RigSource):
        return session.source.description
    name = str(session.row.source.get("file"))
    if rigs is None or not rigs.is_dir() or name not in {item.name for item in rigs.iterdir()}:
        raise RigUnlimited(f"the rig file {name} of this session is not in the service's folder of rigs any more")
    return read_rig(rigs / name)


def _rig_opener(session: LiveSession, wanted: RecommendedPass, rigs: Path | None) -> Callable[[], Source]:
    known = description = _description_of(session, rigs)
    turn = wanted.turn
    if isinstance(wanted.motion, StraightMotion) and turn is not None and not turn.is_none:
        # the part lies otherwise on the stage; seen from the part the whole rig has turned the other way
        description = replace(
            description,
            part_from_stage=Pose.identity(),
            stage_from_sensor=wanted.motion.at_zero,
            direction_stage=wanted.motion.travel.copy(),
        )
    order = PassOrder(wanted.start_mm, wanted.end_mm, wanted.line_spacing_mm)
    preparation = _preparation_of(session)

    def open_rig() -> Source:
        rig = RunningRig(description)
        return RigSource(rig, order, rig.enter(), preparation, known)

    return lambda: _patiently(open_rig)


def _preparation_of(session: LiveSession) -> Preparation:
    """How the stage gets to know where it is: as the session's own pass did, or from where the last pass left it."""
    known: dict[str, Any] = dict(session.row.source)
    if known.get("home"):
        return Preparation(home=True)
    if known.get("at_mm") is None:
        return Preparation()
    rests = session.source.rests_at_mm if isinstance(session.source, RigSource) else None
    if rests is None:
        raise SourceUnusable(
            "nobody knows where the stage is since the last pass: make a new session that homes it, or states where it "
            "is"
        )
    return Preparation(at_mm=rests)


def _patiently(open_source: Callable[[], Source], tries: int = 3) -> Source:
    """Open ports again; what the pass before left on the wire may spoil the first greeting."""
    for _ in range(tries - 1):
        try:
            return open_source()
        except (ScannerSilent, PortBusy) as error:
            _LOG.info("the scanner did not answer at once: %s", error)
    return open_source()
