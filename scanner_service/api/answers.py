"""How values become JSON answers: NaN is null, arrays are lists, enumerations their values; knows no route."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from starlette.responses import JSONResponse


def plain(value: Any) -> Any:
    """The value as JSON can say it: what is not a finite number becomes None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def answer(value: Any, status_code: int = 200, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """A JSON answer in which NaN is null."""
    return JSONResponse(plain(value), status_code, dict(headers) if headers else None)
