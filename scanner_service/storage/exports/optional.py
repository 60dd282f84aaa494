"""Libraries that only some formats need, fetched when they are, with one clear sentence when they are not there."""

import importlib
from typing import Any

from scanner_service.storage.exports.errors import ExtraMissing


def laspy_module() -> Any:
    """laspy with its LAZ backend; raises ExtraMissing."""
    _module("lazrs", "LAS and LAZ", "las")
    return _module("laspy", "LAS and LAZ", "las")


def pye57_module() -> Any:
    """pye57; raises ExtraMissing."""
    return _module("pye57", "E57", "e57")


def parquet_modules() -> tuple[Any, Any]:
    """pyarrow and pyarrow.parquet; raises ExtraMissing."""
    return _module("pyarrow", "Parquet", "parquet"), _module("pyarrow.parquet", "Parquet", "parquet")


def _module(name: str, formats: str, extra: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ExtraMissing(
            f"{formats} files need {package}, which is not installed: in the checkout, run "
            f"`.venv/bin/pip install -e '.[{extra}]'`"
        ) from error
