"""How commands speak: what they are told to say is said to the letter."""

import pytest
import typer
from typer.testing import CliRunner

from scanner_service.cli import app
from scanner_service.commands.terminal import errors, fail
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
