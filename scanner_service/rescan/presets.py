"""Requirements by name, for whoever does not want to choose eight numbers; knows numbers only."""

from dataclasses import replace
from math import radians
from typing import Any

from scanner_service.rescan.requirement import Requirement, RequirementUnusable

PRESETS: dict[str, Requirement] = {
    "overview": Requirement(density_share=0.25, coverage_share=0.90),
    "standard": Requirement(coverage_share=0.95),
    "inspection": Requirement(
        line_spacing_mm=0.3, chord_error_mm=0.01, incidence_rad=radians(65.0), coverage_share=0.98
    ),
    "fine": Requirement(line_spacing_mm=0.15, chord_error_mm=0.005, incidence_rad=radians(60.0), coverage_share=0.99),
}
"""From the loosest to the finest; what a preset leaves out has the default of `Requirement`."""


def requirement_of(preset: str | None = None, **asked: Any) -> Requirement:
    """A preset with what the user asks for in its place; a value of None asks for nothing new.

    Raises
    ------
    RequirementUnusable : no such preset, or what is asked for cannot be met.
    """
    if preset is not None and preset not in PRESETS:
        raise RequirementUnusable(f"there is no preset {preset}; the presets are {', '.join(PRESETS)}", "preset")
    base = Requirement() if preset is None else PRESETS[preset]
    return replace(base, **{name: value for name, value in asked.items() if value is not None})


def preset_of(requirement: Requirement) -> str | None:
    """The name of the preset that asks for just the same; None when there is none."""
    asked = replace(requirement, radius_constant_mm=Requirement().radius_constant_mm)
    return next((name for name, preset in PRESETS.items() if preset == asked), None)
