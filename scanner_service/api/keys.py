"""API keys and the file they are kept in: makes, recognises and compares them; knows no request.

A key is `scn_`, 256 random bits in base32, and a CRC-32 of everything before it in base32. The checksum tells a
mistyped key from an unknown one without any file. The file holds only the SHA-256 of each key: the keys are random, so
nothing slower is needed.
"""

import base64
import hashlib
import hmac
import json
import os
import stat
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

Entropy = Callable[[int], bytes]

KEY_PREFIX = "scn_"
KEY_BYTES = 32
_SECRET_CHARS = 52
_CHECK_CHARS = 7
KEYS_FILE = "keys.json"
LOCAL_KEY_FILE = "local-key"


class Role(IntEnum):
    """Who may do what; each role may do all that the ones before it may."""

    VIEWER = 1
    OPERATOR = 2
    ADMIN = 3


class KeyStoreError(Exception):
    """The files of the keys cannot be used: `KeyFileExposed`, `KeyFileDamaged`."""


class KeyFileExposed(KeyStoreError):
    """Others than the owner may read or change a file that holds keys."""


class KeyFileDamaged(KeyStoreError):
    """The file of the keys cannot be understood."""


@dataclass(frozen=True, slots=True)
class StoredKey:
    """What is kept of a key: never the key. `key_id` are the first 12 hexadecimal digits of `sha256`."""

    role: Role
    label: str
    sha256: str

    @property
    def key_id(self) -> str:
        """A name for the key that tells nothing of it."""
        return self.sha256[:12]


def make_key(rng: Entropy) -> str:
    """A new key from 32 bytes of `rng` (in service `secrets.token_bytes`)."""
    body = KEY_PREFIX + _base32(rng(KEY_BYTES))
    return body + _checksum(body)


def is_well_formed(key: str) -> bool:
    """True when prefix, length and checksum fit: the key was not mistyped, whether or not it is known."""
    if len(key) != len(KEY_PREFIX) + _SECRET_CHARS + _CHECK_CHARS or not key.isascii():
        return False
    body, check = key[:-_CHECK_CHARS], key[-_CHECK_CHARS:]
    return key.startswith(KEY_PREFIX) and _checksum(body) == check


def sha256_of(secret: str) -> str:
    """SHA-256 of a key or token, hexadecimal."""
    return hashlib.sha256(secret.encode()).hexdigest()


def find(keys: tuple[StoredKey, ...], key: str) -> StoredKey | None:
    """The stored key that `key` is, or None; takes the same time wherever and whether it is found."""
    digest = sha256_of(key)
    found = None
    for stored in keys:
        if hmac.compare_digest(stored.sha256, digest):
            found = stored
    return found


def load_keys(data_dir: Path) -> tuple[StoredKey, ...]:
    """The keys of a data directory; none when the file does not exist.

    Raises
    ------
    KeyFileExposed, KeyFileDamaged
    """
    path = data_dir / KEYS_FILE
    text = _read_private(path)
    if text is None:
        return ()
    try:
        rows = json.loads(text)["keys"]
        return tuple(StoredKey(Role[row["role"].upper()], str(row["label"]), _digest(row["sha256"])) for row in rows)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise KeyFileDamaged(
            f"{path} is not a key file ({type(error).__name__}); restore it, or remove it to start with a new key."
        ) from error


def save_keys(data_dir: Path, keys: tuple[StoredKey, ...]) -> None:
    """Write the file of the keys, readable by its owner only, whole or not at all."""
    rows = [{"role": key.role.name.lower(), "label": key.label, "sha256": key.sha256} for key in keys]
    _write_private(data_dir / KEYS_FILE, json.dumps({"keys": rows}, indent=1) + "\n")


def save_local_key(data_dir: Path, key: str) -> None:
    """Keep the key of this machine's own commands, readable by its owner only."""
    _write_private(data_dir / LOCAL_KEY_FILE, key + "\n")


def read_local_key(data_dir: Path) -> str | None:
    """The key that commands on this machine use; None when no service has run on this data directory.

    Raises
    ------
    KeyFileExposed, KeyFileDamaged
    """
    text = _read_private(data_dir / LOCAL_KEY_FILE)
    if text is None:
        return None
    if not is_well_formed(text.strip()):
        raise KeyFileDamaged(f"{data_dir / LOCAL_KEY_FILE} holds no key; remove it and start the service again.")
    return text.strip()


def _base32(data: bytes) -> str:
    return base64.b32encode(data).decode("ascii").rstrip("=").lower()


def _checksum(body: str) -> str:
    return _base32(zlib.crc32(body.encode("ascii")).to_bytes(4, "big"))


def _digest(text: object) -> str:
    if not isinstance(text, str) or len(bytes.fromhex(text)) != hashlib.sha256().digest_size:
        raise ValueError("not a SHA-256")
    return text.lower()


def _read_private(path: Path) -> str | None:
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise KeyFileDamaged(f"{path} cannot be read: {error.strerror}.") from error
    with os.fdopen(descriptor, encoding="ascii", errors="replace") as file:
        mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
        if os.name == "posix" and mode & 0o077:
            raise KeyFileExposed(f"{path} may be read by others (mode {mode:o}); run: chmod 600 {path}")
        return file.read()


def _write_private(path: Path, text: str) -> None:
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)  # left by a process that was killed
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)
