"""`scanner simulate`: a simulated scanner of one of the known kinds behind a pseudo-terminal."""

import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanner_service.commands.terminal import console, errors, fail, plain_errors, show_json

if TYPE_CHECKING:
    from simulators.parts import Part


def simulate_command(
    device: Annotated[
        str, typer.Option(help="Kind of scanner: native (with a stage of its own), scip, lms200, rplidar or ls100.")
    ] = "native",
    part: Annotated[str, typer.Option(help="Part under the scanner: demo, plate, step or sphere.")] = "demo",
    turntable: Annotated[
        bool, typer.Option("--turntable", help="A part on a turntable, which has a port of its own.")
    ] = False,
    rig_file: Annotated[
        Path | None, typer.Option(help="Write the rig file of scanner and turntable; with --turntable only.")
    ] = None,
    mesh: Annotated[Path | None, typer.Option(help="A mesh instead: .stl, .obj or .ply.")] = None,
    scale: Annotated[float, typer.Option(help="Millimetres in one unit of the mesh.")] = 1.0,
    speed: Annotated[
        float, typer.Option(min=0.0, help="Speed in mm/s at which the part passes under a scanner without a stage.")
    ] = 5.0,
    baud: Annotated[
        int | None, typer.Option(min=1, help="Rate of a native scanner's wire, 3000000 if not given.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of noise, dropouts and faults.")] = 1,
    link: Annotated[Path | None, typer.Option(help="A symbolic link that always names the terminal.")] = None,
    flip_rate: Annotated[float, typer.Option(help="Chance that a bit is flipped on the wire.")] = 0.0,
    loss_rate: Annotated[float, typer.Option(help="Chance that a byte is lost on the wire.")] = 0.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the port as a line of JSON.")] = False,
) -> None:
    """Simulate a scanner and print the port to open; runs until Ctrl-C."""
    try:
        from simulators.faults import Faults  # noqa: PLC0415 - an extra: tell how to get it
        from simulators.meshes import MeshError  # noqa: PLC0415
        from simulators.parts import PARTS, mesh_part  # noqa: PLC0415
        from simulators.process import serve_simulated_scanner  # noqa: PLC0415
        from simulators.pty_port import SimulatedPortError  # noqa: PLC0415
        from simulators.turntable import turned_part  # noqa: PLC0415
    except ImportError as error:
        fail(f"the simulator needs {error.name}: in the checkout, run `.venv/bin/pip install -e '.[simulation]'`")
    if mesh is None and part not in PARTS:
        fail(f"there is no part {part}; the parts are {', '.join(sorted(PARTS))}")
    if rig_file is not None and not turntable:
        fail("a rig file puts a scanner and a turntable together: say --turntable too")
    if turntable and (mesh is not None or part != "demo"):
        fail("on the turntable stands a part of its own: leave out --part and --mesh, or --turntable")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())

    def announce(event: dict[str, object]) -> None:
        if as_json:
            show_json(event)
            return
        console.print(f"port: {event['port']}", highlight=False, soft_wrap=True)
        if turntable:
            console.print(f"turntable: {event['stage_port']}", highlight=False, soft_wrap=True)
        errors.print(f"{event['part']}, {event['baud_rate']} baud. Ctrl-C ends it.")

    def subject() -> "Part":
        if turntable:
            return turned_part()
        return mesh_part(mesh, scale) if mesh is not None else PARTS[part]()

    with plain_errors():
        try:
            serve_simulated_scanner(
                subject(),
                stop=stop,
                announce=announce,
                kind=device,
                baud_rate=baud,
                speed_mm_per_s=speed,
                seed=seed,
                link_path=link,
                turntable=turntable,
                rig_file=rig_file,
                faults=Faults(bit_error_rate=flip_rate, byte_loss_rate=loss_rate),
            )
        except (SimulatedPortError, MeshError) as error:
            fail(str(error))
