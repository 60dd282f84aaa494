"""The data folder as every command calls it; knows no service, which takes a second to import."""

from pathlib import Path
from typing import Annotated

import typer

DATA_HELP = "Folder of the record, the keys and the replay files."
Data = Annotated[Path, typer.Option("--data", envvar="SCANNER_DATA", help=DATA_HELP)]
DEFAULT_DATA = Path.home() / ".local" / "share" / "scanner-service"
