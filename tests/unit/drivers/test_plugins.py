"""Drivers that other packages add by entry points: found by name, told apart, and never in place of ours."""

import textwrap

import pytest

from drivers.errors import DriverUnknown
from drivers.rig_file import parse_rig
from drivers.scanners.known import KNOWN as SCANNERS
from drivers.scanners.known import known_scanner, open_scanner
from drivers.stages.known import KNOWN as STAGES
from drivers.stages.known import known_stage, open_stage, stage_names

MODULE = """
    from drivers.scanners.known import KnownScanner
    from drivers.stages.grbl import OPTIONS, open_grbl
    from drivers.stages.known import KnownStage

    STAGE = KnownStage("acme", "a stage of ACME", (9600,), open_grbl, options=OPTIONS)
    SCANNER = KnownScanner("acme", "a scanner of ACME", (9600,), lambda path, rate: (path, rate), True)
    WRONG = 42
"""
POINTS = """
    [scanner_service.stages]
    acme = acme_driver:STAGE
    grbl = acme_driver:WRONG
    lost = acme_driver:NOTHING
    absent = no_such_module:STAGE
    wrong = acme_driver:WRONG

    [scanner_service.scanners]
    acme = acme_driver:SCANNER
"""


@pytest.fixture
def acme(tmp_path, monkeypatch):
    (tmp_path / "acme_driver.py").write_text(textwrap.dedent(MODULE))
    about = tmp_path / "acme_driver-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-driver\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(textwrap.dedent(POINTS))
    monkeypatch.syspath_prepend(str(tmp_path))


def test_an_added_driver_is_opened_by_its_name(acme):
    assert known_stage("acme").title == "a stage of ACME"
    assert "acme" in stage_names()
    assert open_scanner("acme", "/dev/ttyS9") == ("/dev/ttyS9", 9600)
    rig = parse_rig(
        "[scanner]\nkind='acme'\nport='/dev/a'\n"
        "[stage]\nkind='acme'\nport='/dev/b'\ntravel_mm=[0, 9]\noptions={letter='Y'}"
    )
    assert open_stage(rig).position_known is False


def test_a_driver_of_ours_is_never_replaced(acme):
    assert known_stage("grbl") is STAGES["grbl"]
    assert known_scanner("native") is SCANNERS["native"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("lost", "cannot be loaded"),
        ("absent", "cannot be loaded"),
        ("wrong", "is a int, not a KnownStage"),
        ("unheard_of", "the stages are .*acme.*grbl.*zaber"),
    ],
)
def test_an_added_driver_that_is_none_is_told(acme, name, said):
    with pytest.raises(DriverUnknown, match=said):
        known_stage(name)


def test_an_unknown_scanner_is_told_with_those_there_are():
    with pytest.raises(DriverUnknown, match=r"there is no scanner 'x'; the scanners are .*native.*scip"):
        known_scanner("x")
