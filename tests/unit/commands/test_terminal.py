"""How commands speak: what they are told to say is said to the letter."""

import pytest
import typer
from typer.testing import CliRunner

from scanner_service.cli import app
from scanner_service.commands.terminal import errors, fail, loss_sentence, scan_progress
from scanner_service.storage.record import Record


def test_brackets_in_a_sentence_are_no_markup():
    with errors.capture() as said, pytest.raises(typer.Exit):
        fail("install scanner-service[simulation], or see [/part]")
    assert said.get().strip() == "install scanner-service[simulation], or see [/part]"


def test_an_option_that_a_record_would_ignore_is_refused(tmp_path):
    Record.open(tmp_path / "record.sqlite").close()
    run = CliRunner().invoke(
        app,
        ["replay", str(tmp_path / "record.sqlite"), "--out", str(tmp_path / "out"), "--density", "3", "--noise", "0"],
    )
    assert run.exit_code == 1
    assert "--density, --noise" in run.output


def _losses():
    """Of two passes: one whose rate overran the wire, one of a rig that measured before the stage set off as well."""

    def account(sent, partial, lost, chunks):
        stored = sent - sum(lost.values())
        lines = {"sent": sent, "stored": stored, "whole": stored - partial, "partial": partial, "under_way": 0,
                 "duplicates": 0, "lost": lost}  # fmt: skip
        return {"device_id": "A", "boot_id": 1, "pass_index": 0, "lines": lines, "chunks": chunks}

    overrun = {"sent": 1608, "stored": 1200, "lost": {"device_dropped": 408}}
    return {
        "passes": [
            account(201, 79, {}, overrun),
            account(100, 0, {"disconnected": 2, "refused_invalid": 1, "before_start": 30}, None),
        ]
    }


def test_a_scan_that_lost_something_says_what_and_why_at_its_end():
    said = loss_sentence(_losses())
    assert "of 301 scanlines 79 are partial, 3 lost (2 disconnected, 1 refused invalid)" in said
    assert "of 1,608 chunks 408 were lost (408 device dropped)" in said
    assert "before start" not in said  # not wanted, and no loss
    assert "lower line rate" in said
    assert "This computer" not in said
    whole = {"passes": [account | {"chunks": None, "lines": account["lines"] | {"partial": 0, "lost": {}}}
                        for account in _losses()["passes"]]}  # fmt: skip
    assert loss_sentence(whole) == "No scanline was lost, and none is partial."


def _read(line_rate_hz=None, late_reads=0, **device):
    """What a driver counted whose wire carries 71 lines/s."""
    rates = {} if line_rate_hz is None else {"line_rate_hz": line_rate_hz, "wire_line_rate_hz": 71.0}
    return rates | {"late_reads": late_reads, "largest_pause_s": 1.26 if late_reads else 0.03} | device


@pytest.mark.parametrize(
    ("device", "scanner", "computer"),
    [
        (_read(50.0, late_reads=3), "", "(late 3 times, by up to 1.3 s)"),
        (_read(50.0, late_reads=1), "", "(late once, by up to 1.3 s)"),
        (_read(90.0), "wire carries", ""),
        (_read(90.0, late_reads=3), "wire carries", "by up to 1.3 s"),
        (_read(50.0), "has time for", ""),
        (_read(damage={"uart_overrun": 7}), "wire carries", "too busy"),
        ({}, "wire carries", ""),
    ],
)
def test_what_helps_against_losses_is_told_by_what_was_counted(device, scanner, computer):
    """A computer that came late to read is no scanner that measured too much, and the other way round."""
    _, _, advice = loss_sentence(_losses() | {"device": device}).partition(". ")
    assert ("scanner" in advice.lower(), "computer" in advice) == (bool(scanner), bool(computer))
    assert scanner in advice and computer in advice


def test_lines_that_came_and_found_no_room_are_laid_to_this_computer():
    first, *_ = _losses()["passes"]
    lost = first | {"lines": first["lines"] | {"lost": {"host_overflow": 4}}, "chunks": None}
    said = loss_sentence({"passes": [lost], "device": _read()})
    assert "This computer was too busy" in said and "scanner" not in said.lower()


@pytest.mark.parametrize(
    ("kind", "progress", "coverage", "said"),
    [
        ("observed", 0.22, 1.0, "coverage so far 100.0%"),
        ("observed", 1.0, 0.5, "observed coverage 50.0%"),
        ("reference", 0.22, 0.2, "coverage of the nominal part 20.0%"),
        ("observed", 0.01, None, "coverage –"),
    ],
)
def test_progress_says_what_the_coverage_is_of_and_counts_partial_lines(kind, progress, coverage, said):
    status = {"lines": 201, "points_per_s": 9.0, "coverage": coverage, "coverage_kind": kind, "progress": progress}
    with errors.capture() as told, scan_progress("scanning") as bar:
        bar.show(status | {"losses": _losses()})
    text = " ".join(told.get().split())
    assert said in text
    assert "3 lines lost, 79 partial" in text


def test_only_the_program_itself_offers_to_install_a_completion():
    of_all, of_one = (CliRunner().invoke(app, [*command, "--help"]).output for command in ([], ["verify"]))
    assert "--install-completion" in of_all
    assert "--json" in of_one and "completion" not in of_one
