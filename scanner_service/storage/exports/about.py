"""What a file says of where it comes from: software, session, settings, raw data; the same words in every format."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from scanner_service import __version__


@dataclass(frozen=True, slots=True)
class About:
    """Where exported points come from. `raw_sha256` is the hash of the stored lines ("" when there are none).

    `created_utc` is the session's own time (ISO 8601), not that of the export, so that equal data give equal files.
    """

    session_id: str = ""
    name: str = ""
    created_utc: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    raw_sha256: str = ""
    version: str = __version__

    @property
    def software(self) -> str:
        """Name and version of what wrote the file."""
        return f"scanner-service {self.version}"

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "software": self.software,
            "session": self.session_id,
            "name": self.name,
            "created_utc": self.created_utc,
            "units": "mm",
            "settings": dict(self.settings),
            "raw_sha256": self.raw_sha256,
        }

    def to_text(self) -> str:
        """One line of ASCII JSON, for the comment or note of a file format."""
        return json.dumps(self.to_dict(), sort_keys=True, allow_nan=False)
