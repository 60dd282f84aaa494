"""Scanners by name: plain values become options, and what cannot be is said in one sentence."""

import math
import re
from pathlib import Path

import pytest

from drivers.errors import DriverError
from drivers.protocols.lms_host import LmsOptions
from drivers.protocols.ls100_host import Ls100Options
from drivers.protocols.rplidar_host import RplidarOptions
from drivers.protocols.scip_plan import ScipOptions
from drivers.scanners.free_running import FreeRunner
from drivers.scanners.known import KNOWN, known_scanner, open_free_running, open_scanner
from drivers.scanners.native import NativeScanner
from drivers.scanners.options import options_from

PAGES = Path(__file__).resolve().parents[3] / "docs" / "devices"


def test_each_name_makes_its_driver_without_opening_anything() -> None:
    assert set(KNOWN) == {"native", "scip", "lms200", "rplidar", "ls100"}
    for name, known in KNOWN.items():
        scanner = open_scanner(name, "/dev/does-not-exist")
        assert isinstance(scanner, FreeRunner if known.runs_free else NativeScanner)
        assert known.baud_rates
    with pytest.raises(DriverError, match="there is no scanner 'laser'; the scanners are lms200, ls100, native"):
        known_scanner("laser")
    with pytest.raises(DriverError, match="has a stage of its own"):
        open_free_running("native", "/dev/does-not-exist")


def test_plain_values_become_options() -> None:
    scip = options_from(ScipOptions, {"command": "MS", "cluster": 2, "from_deg": -45, "to_deg": 45.0, "interval": 3})
    assert scip == ScipOptions((-math.pi / 4, math.pi / 4), "MS", 2, 3)
    lms = options_from(LmsOptions, {"scan_angle_deg": 100, "resolution_hundredths_deg": 25, "work_rate": 500_000})
    assert lms == LmsOptions((100, 25), 500_000)
    assert options_from(RplidarOptions, {"mode": "standard", "signed_offsets": True}) == RplidarOptions(
        "standard", signed_offsets=True
    )
    assert options_from(Ls100Options, {"step": 3, "has_time": True, "name": "left"}) == Ls100Options(
        3, True, name="left"
    )
    assert options_from(ScipOptions, {}) == ScipOptions()
    assert isinstance(open_scanner("scip", "/dev/none", None, {"cluster": 2}), FreeRunner)


@pytest.mark.parametrize(
    ("kind", "values", "sentence"),
    [
        (ScipOptions, {"speed": 3}, "no option 'speed'; its options are .*from_deg, to_deg, command, cluster"),
        (ScipOptions, {"from_deg": -45}, "given together"),
        (ScipOptions, {"from_deg": "a", "to_deg": 1}, "must be numbers"),
        (ScipOptions, {"cluster": "2"}, "cluster cannot be '2'"),
        (ScipOptions, {"cluster": 2.5}, r"cluster cannot be 2\.5"),
        (ScipOptions, {"cluster": 0}, "cluster must be 1 to 99"),
        (ScipOptions, {"command": True}, "command cannot be True"),
        (RplidarOptions, {"signed_offsets": 1}, "cannot be 1"),
        (Ls100Options, {"laser_mm": 3}, "no option 'laser_mm'"),
        (LmsOptions, {"scan_angle_deg": 90, "resolution_hundredths_deg": 25}, "cannot measure"),
    ],
)
def test_options_that_cannot_be_are_told(kind: type, values: dict[str, object], sentence: str) -> None:
    with pytest.raises(DriverError, match=sentence):
        options_from(kind, values)


def test_options_of_a_kind_that_has_none_are_refused() -> None:
    with pytest.raises(DriverError, match="native has no option 'speed'; it has none"):
        open_scanner("native", "/dev/none", None, {"speed": 1})


@pytest.mark.parametrize("name", [name for name, known in KNOWN.items() if known.options is not None])
def test_the_page_of_each_scanner_names_its_options_and_no_others(name: str) -> None:
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    table = re.search(r"^\| option .*?\n\n", text, re.MULTILINE | re.DOTALL)[0]
    named = {word for row in table.strip().splitlines()[2:] for word in re.findall(r"`(\w+)`", row.split("|")[1])}
    with pytest.raises(DriverError) as refusal:
        options_from(known_scanner(name).options, {"no_such_option": 1})
    assert named == set(str(refusal.value).partition("its options are ")[2].split(", "))
    rates = ", ".join(str(rate) for rate in KNOWN[name].baud_rates[:2])
    assert name == "ls100" or all(rate in text for rate in rates.split(", "))
