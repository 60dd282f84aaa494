"""What stands for a value in the help of the commands: its unit, its choices, or what it names; no Python type."""

from typing import Any

PLACEHOLDERS = {
    "session": "id",
    "session_id": "id",
    "text": "words",
    "files": "path",
    "--allow-host": "<name>",
    "--allow-origin": "<origin>",
    "--at": "<mm>",
    "--ball-factor": "<factor>",
    "--baud": "<bit/s>",
    "--cancel": "<order>",
    "--ceiling": "<mm>",
    "--checks": "<count>",
    "--chord-error": "<mm>",
    "--coverage": "<share>",
    "--density": "<points/mm²>",
    "--device": "<kind>",
    "--disk-budget-gb": "<GB>",
    "--end": "<mm>",
    "--flip-rate": "<chance>",
    "--floor": "<mm>",
    "--format": "<format>",
    "--host": "<address>",
    "--incidence": "<degrees>",
    "--interest": "<x,y,z,x,y,z>",
    "--keep": "<order>",
    "--keep-days": "<days>",
    "--largest-noise": "<mm>",
    "--laser": "<x,y,z>",
    "--limit": "<count>",
    "--line-spacing": "<mm>",
    "--loss-rate": "<chance>",
    "--max-error": "<degrees>",
    "--max-passes": "<count>",
    "--max-radius": "<mm>",
    "--max-seconds": "<s>",
    "--memory-mb": "<MB>",
    "--method": "<name>",
    "--neighbours": "<count>",
    "--noise": "<mm>",
    "--part": "<name>",
    "--pass": "<number>",
    "--plan": "<id>",
    "--points": "<count>",
    "--points-at-once": "<count>",
    "--port": "<number>",
    "--preset": "<name>",
    "--radius": "<mm>",
    "--rate": "<lines/s>",
    "--reason": "<reason>",
    "--record": "<file or address>",
    "--reference-units": "<mm|m|inch>",
    "--region": "<number>",
    "--repeats": "<count>",
    "--rule": "<fixed|flexible|global>",
    "--scale": "<mm>",
    "--seconds": "<s>",
    "--seed": "<number>",
    "--seen-from": "<x,y,z>",
    "--session": "<id>",
    "--shape": "<name>",
    "--spacing": "<mm>",
    "--speed": "<mm/s>",
    "--spool-mb": "<MB>",
    "--start": "<mm>",
    "--surface-spacing": "<mm>",
    "--threads": "<count>",
    "--units": "<mm|m|inch|auto>",
    "--url": "<address>",
    "--withdraw": "<order>",
    "compare --noise": "<level>",
    "devices --port": "<device>",
    "doctor --port": "<device>",
    "replay --record": "<path>",
    "replay --speed": "<times>",
}
"""By the name of the option or argument; behind the name of a command for that command alone."""


def _nothing(ctx: Any = None) -> str:
    return ""


def put_placeholders(command: Any, name: str) -> None:
    """Put them into the help of a command (click), and of its own commands."""
    for parameter in command.params:
        for option in (*parameter.opts, parameter.name):
            placeholder = PLACEHOLDERS.get(f"{name} {option}", PLACEHOLDERS.get(option))
            if placeholder is not None and not getattr(parameter, "is_flag", False):
                parameter.metavar = placeholder
                if parameter.param_type_name == "argument":
                    parameter.display_type_rich = _nothing  # the type would stand beside it
                break
    for inner, own in getattr(command, "commands", {}).items():
        put_placeholders(own, inner)
