"""Help and output of the commands: values are told by what they are, and nothing is wrapped where nobody looks."""

import io
import re

import pytest
import typer

from scanner_service.cli import app
from scanner_service.commands.terminal import paper

TYPES = re.compile(r"<(class|str|int|float|bool|list|integer|any)\b|\b(TEXT|INTEGER|FLOAT)\b")


def commands(command=None, path=("scanner",)):
    """Every command of the program, with its context."""
    command = command or typer.main.get_command(app)
    context = command.make_context(path[-1], [], resilient_parsing=True)
    yield " ".join(path), command, context
    for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
        yield from commands(command.get_command(context, name), (*path, name))


def test_no_help_names_a_type_of_the_language():
    told = {
        f"{path}: {record[0]}"
        for path, command, context in commands()
        for parameter in command.params
        if (record := parameter.get_help_record(context))
    }
    assert len(told) > 100
    assert [each for each in sorted(told) if TYPES.search(each)] == []


def test_lists_of_commands_say_what_each_does_and_cut_nothing():
    for path, command, context in commands():
        if hasattr(command, "list_commands"):
            told = " ".join(command.get_help(context).partition("Commands:")[2].split())
            assert "..." not in told, path
            for name in command.list_commands(context):
                said = " ".join((command.get_command(context, name).help or "").split()).split(". ")[0].rstrip(".")
                assert said and f"{name} {said}" in told, (path, name)


class Terminal(io.StringIO):
    """A stream on which somebody looks."""

    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "environment", "lines"),
    [(io.StringIO, {}, 1), (io.StringIO, {"COLUMNS": "80"}, 5), (Terminal, {"COLUMNS": "40"}, 10)],
)
def test_a_long_sentence_is_one_line_in_a_file_unless_a_width_is_asked_for(stream, environment, lines):
    file = stream()
    paper(file, environment).print("seventy " * 49 + "end")
    assert file.getvalue().count("\n") == lines
