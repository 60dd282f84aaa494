"""`scanner devices` and `scanner doctor`: which ports there are, who answers there, what is wrong and what to do."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from drivers.doctor import UDEV_RULE, Finding, Level, check_machine, check_port, check_rig
from drivers.errors import DriverError
from drivers.port import check_device_file
from drivers.port_names import PortName, find_port, list_ports
from drivers.rig_file import read_rig
from drivers.scanners.known import identify
from drivers.stages.known import identify_stage
from scanner_service.commands.terminal import console, errors, plain_errors, show_json

_MARKS = {Level.GOOD: "ok", Level.WARNING: "warning", Level.PROBLEM: "PROBLEM"}


def devices_command(
    port: Annotated[list[str] | None, typer.Option(help="Only this port, or one the kernel does not list.")] = None,
    identify_them: Annotated[
        bool, typer.Option("--identify", help="Ask on each port who is there; a motion under way there is ended.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the ports as JSON.")] = False,
) -> None:
    """List the serial ports with the names that survive a replug and, if asked, who answers on them."""
    with plain_errors():
        ports = [_named(name) for name in port] if port else list_ports()
        told = [
            {**asdict(item), "lasting": item.lasting, "usb_name": item.usb_name, "is_built_in": item.is_built_in}
            for item in ports
        ]
        if identify_them:
            for item, entry in zip(ports, told, strict=True):
                errors.print(f"asking {item.path} ...", highlight=False, soft_wrap=True)
                entry["device"] = who_answers(item.path)
        if as_json:
            show_json(told)
            return
        if not told:
            errors.print("No serial adapter is plugged in; `scanner doctor` says more.", highlight=False)
            return
        table = Table(title="Serial ports", title_justify="left")
        for column in (
            ("port", "adapter", "name it", "who answers") if identify_them else ("port", "adapter", "name it")
        ):
            table.add_column(column, overflow="fold")
        for entry in told:
            adapter = " ".join(str(entry[key]) for key in ("product", "usb_name") if entry[key]) or (
                "of the computer itself" if entry["is_built_in"] else str(entry["driver"])
            )
            row = [str(entry["path"]), adapter, str(entry["lasting"])]
            table.add_row(*row, *([_shown(entry["device"])] if identify_them else []))
        console.print(table)


def _told(port: PortName) -> dict[str, Any]:
    names = {"lasting": port.lasting, "usb_name": port.usb_name, "is_built_in": port.is_built_in}
    return asdict(port) | names


def _named(name: str) -> PortName:
    """The port of that name, with its adapter where the kernel lists it; raises a PortError when there is none."""
    path = find_port(name)
    check_device_file(path)
    return _known_or_bare(path)


def _known_or_bare(path: str) -> PortName:
    known = (port for port in list_ports() if path and path in (port.path, port.by_id, port.by_path))
    return next(known, PortName(path))


def who_answers(path: str) -> dict[str, Any]:
    """Ask on a port who is there, stages first: they answer the soonest; `problem` tells why nobody could be asked."""
    try:
        stage = identify_stage(path)
        if stage is not None:
            return {
                "what": "stage", "kind": stage.stage.name, "identity": stage.identity, "baud_rate": stage.baud_rate
            }  # fmt: skip
        scanner = identify(path)
    except DriverError as error:
        return {"problem": str(error)}
    if scanner is None:
        return {"what": "nothing known"}
    identity = f"{scanner.info.model} {scanner.info.device_id}"
    return {"what": "scanner", "kind": scanner.scanner.name, "identity": identity, "baud_rate": scanner.baud_rate}


def _shown(device: Any) -> str:
    if "problem" in device:
        return str(device["problem"])
    if "kind" not in device:
        return "nothing known"
    return f"{device['what']} {device['kind']}: {device['identity']}, {device['baud_rate']} baud"


def doctor_command(
    rig: Annotated[Path | None, typer.Argument(help="Rig file (TOML) to be checked against its devices.")] = None,
    port: Annotated[
        list[str] | None, typer.Option(help="Look at this port, also if the kernel does not list it.")
    ] = None,
    udev_rule: Annotated[bool, typer.Option("--udev-rule", help="Print a udev rule for serial adapters.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Say what is wrong with ports, permissions and a rig, and what to do about it; nothing is moved."""
    if udev_rule:
        console.print(UDEV_RULE, end="", highlight=False, soft_wrap=True)
        return
    with plain_errors():
        findings: list[Finding] = []
        description = read_rig(rig) if rig is not None else None
        if port:
            for name in port:
                findings += check_port(_known_or_bare(find_port(name)))
        elif description is None:
            findings += check_machine()
        if description is not None:
            findings += check_rig(description)
        problems = sum(finding.level is Level.PROBLEM for finding in findings)
        if as_json:
            show_json([asdict(finding) for finding in findings])
        else:
            for finding in findings:
                console.print(
                    f"{_MARKS[finding.level]:8} {finding.about}: {finding.found}", highlight=False, soft_wrap=True
                )
                if finding.remedy:
                    console.print(f"         -> {finding.remedy}", highlight=False, soft_wrap=True)
        if problems:
            raise typer.Exit(1)
