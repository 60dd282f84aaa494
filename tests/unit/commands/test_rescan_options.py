"""What `scanner rescan` is asked for together must make sense together; it is refused before any service is asked."""

import pytest
from typer.testing import CliRunner

from scanner_service.cli import app


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--coverage", "0.5"], "say --auto as well"),
        (["--auto", "--cancel", "1"], "say one of --pass, --auto, --cancel"),
        (["--withdraw", "1", "--keep", "1"], "--withdraw and --keep"),
        (["--pass", "1"], "say --pass and --plan together"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, says):
    done = CliRunner().invoke(app, ["rescan", "latest", *options])
    assert done.exit_code != 0
    assert says in " ".join(done.output.split())
