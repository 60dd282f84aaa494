"""What the record gives and takes, as frozen values; knows no SQL, no file and no thread."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

Outcome = Literal["stored", "duplicate", "conflict"]


@dataclass(frozen=True, slots=True)
class SessionRow:
    """One session. Times are ISO 8601 in UTC. `damaged`: a row of it fails its checksum, its values are doubtful.

    `notes` is what a person says of it, `calibration` what the scanner was that took it; both may be empty.
    """

    session_id: str
    name: str
    created_utc: str
    changed_utc: str
    state: str
    settings: Mapping[str, Any]
    origin_mm: tuple[float, float, float]
    source: Mapping[str, Any]
    damaged: bool = False
    notes: str = ""
    calibration: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CreationKey:
    """What makes a request to create safe to repeat: hashes of the key that came with it, and of what it asked."""

    key_sha256: str
    request_sha256: str


@dataclass(frozen=True, slots=True)
class EventRow:
    """Something that happened in a session. `line_number`: lines stored in the session before it happened."""

    session_id: str
    number: int
    time_utc: str
    kind: str
    line_number: int
    details: Mapping[str, Any]
    damaged: bool = False


class Stored(NamedTuple):
    """The answer to an appended line, given only after its commit has returned.

    `duplicate`: this very line was there already, under `line_number`. `conflict`: another line (or a damaged copy of
    it) is there under this device, boot and index; it stays, and the line appended was not stored.
    """

    line_number: int
    outcome: Outcome


class Watermark(NamedTuple):
    """How far one device's lines of one boot are durable: `line_count` of them from `first_index` to `line_index`."""

    boot_id: int
    line_index: int
    first_index: int
    line_count: int


@dataclass(frozen=True, slots=True)
class Count:
    """Lines of a session and their points (places with a return)."""

    lines: int
    points: int


@dataclass(frozen=True, slots=True)
class DamagedLine:
    """A line that was stored and cannot be read back as it was."""

    session_id: str
    line_number: int
    reason: str


@dataclass(frozen=True, slots=True)
class Verification:
    """The result of reading all of a session: sound lines and points, each damaged line, and everything else wrong."""

    sound: Count
    damaged: tuple[DamagedLine, ...]
    problems: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class WriterState:
    """How the writer is; counts are since the record was opened.

    `state` is `ok`, `failing` (nothing is lost yet: what waits is kept in memory and tried again) or `closed`;
    `reason` says why. `waiting` lines are taken and not yet durable; `refused` ones were offered and are not stored.
    Each line offered is in one place: offered = stored + duplicates + conflicts + refused + waiting (a line that
    cannot be encoded, `NotStorable`, was never offered).
    """

    state: Literal["ok", "failing", "closed"] = "ok"
    reason: str = ""
    waiting_lines: int = 0
    waiting_bytes: int = 0
    stored: int = 0
    duplicates: int = 0
    conflicts: int = 0
    refused: int = 0
    batches: int = 0
    retries: int = 0
    checkpoint_problem: str = ""

    def __str__(self) -> str:
        return self.state if not self.reason else f"{self.state}: {self.reason}"


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of the writer. A batch is what queued up while the last commit ran, up to these bounds.

    The log is copied after `checkpoint_bytes`, while more waits after four times as much. `linger_s` lets a batch that
    is not full wait for more lines: fewer syncs, later acknowledgements.
    """

    batch_bytes: int = 4 << 20
    batch_lines: int = 1024
    linger_s: float = 0.0
    spool_bytes: int = 64 << 20
    checkpoint_bytes: int = 8 << 20
    wal_bytes: int = 64 << 20
    first_retry_s: float = 0.02
    longest_retry_s: float = 2.0
