"""Results as JSON that every reader accepts: no NaN, keys in one order; knows no result.

JSON has no NaN and no infinity. What is not a finite number becomes null, which means "not measured" or "unknown".
"""

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from math import isfinite
from pathlib import Path

import numpy as np

from scanner_service.storage.exports.whole_file import write_whole


def write_json(path: Path, value: object) -> None:
    """Write a value as UTF-8 JSON, whole or not at all.

    Raises
    ------
    TypeError : something in it has no place in JSON.
    ExportNotWritten, ExportNotConfirmed : the file system refused.
    """
    write_whole(path, json_bytes(value))


def json_bytes(value: object) -> bytes:
    """A value as UTF-8 JSON with a final line break; equal values give equal bytes, whatever order they were made in.

    Mappings, sequences, dataclasses, numpy arrays and scalars, paths and enumerations (by their value) are taken.

    Raises
    ------
    TypeError : something in it has no place in JSON, or two keys become the same text.
    """
    text = json.dumps(_plain(value), allow_nan=False, sort_keys=True, ensure_ascii=False, indent=2)
    return (text + "\n").encode("utf-8", "backslashreplace")


def _plain(value: object) -> object:
    if isinstance(value, Enum):
        return _plain(value.value)
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if isfinite(value) else None
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: _plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, Mapping):
        plain = {str(_plain(key)): _plain(item) for key, item in value.items()}
        if len(plain) < len(value):
            raise TypeError("two keys of a JSON object become the same text")
        return plain
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    raise TypeError(f"a {type(value).__name__} has no place in JSON")
