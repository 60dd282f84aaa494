"""The manifest of a folder of exports: what was written, from what, by what, and the SHA-256 of each file.

It finds rot and mistakes. It is no signature: whoever can change a file can write a manifest that agrees with it.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scanner_service.storage.exports.errors import ManifestUnreadable
from scanner_service.storage.exports.results_json import json_bytes
from scanner_service.storage.exports.whole_file import write_whole

MANIFEST = "manifest.json"
MANIFEST_VERSION = 1
_MAX_MANIFEST_BYTES = 4 << 20
_BLOCK_BYTES = 1 << 20
_OWN_HASH = "sha256_of_the_rest"


@dataclass(frozen=True, slots=True)
class Checked:
    """What `verify_folder` found: sound files, a sentence for each problem, and files that the manifest leaves out."""

    sound: tuple[str, ...]
    problems: tuple[str, ...]
    unlisted: tuple[str, ...]
    manifest: Mapping[str, Any]


def write_manifest(folder: Path, names: Iterable[str], facts: Mapping[str, Any]) -> dict[str, Any]:
    """Write the manifest of the named files of a folder, whole or not at all; returns its content.

    Parameters
    ----------
    names : bare names of files in `folder`, which must be there.
    facts : what else is said: software, session, settings, hash of the raw data.

    Raises
    ------
    OSError : a file cannot be read.
    ExportNotWritten, ExportNotConfirmed : the file system refused.
    """
    files = {name: {"bytes": (folder / name).stat().st_size, "sha256": sha256_of(folder / name)} for name in names}
    content = {"manifest_version": MANIFEST_VERSION, **facts, "files": files}
    content[_OWN_HASH] = _own_hash(content)
    write_whole(folder / MANIFEST, json_bytes(content))
    return content


def verify_folder(folder: Path, on_file: Callable[[str], None] = lambda name: None) -> Checked:
    """Compare every file of the manifest with what it says; reads them in blocks, and nothing outside the folder.

    Raises
    ------
    ManifestUnreadable : there is no manifest, or it is damaged, or not one of this version.
    """
    content = _read(folder)
    sound, problems = [], []
    for name, said in content["files"].items():
        on_file(name)
        problem = _problem(folder / name, name, said)
        if problem is None:
            sound.append(name)
        else:
            problems.append(problem)
    there = {path.name for path in folder.iterdir() if path.is_file()}
    return Checked(tuple(sound), tuple(problems), tuple(sorted(there - {*content["files"], MANIFEST})), content)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, read in blocks."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def _problem(path: Path, name: str, said: Mapping[str, Any]) -> str | None:
    try:
        if path.is_symlink() or not path.is_file():
            return f"{name} is gone" if not path.exists() else f"{name} is no ordinary file"
        size = path.stat().st_size
        if size != said["bytes"]:
            return f"{name} has {size} bytes, {said['bytes']} were written"
        if sha256_of(path) != said["sha256"]:
            return f"{name} is not what was written: its SHA-256 differs"
    except OSError as error:
        return f"{name} cannot be read: {error.strerror or error}"
    return None


def _read(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        if path.stat().st_size > _MAX_MANIFEST_BYTES:
            raise ManifestUnreadable(f"{path} is too large for a manifest; it is damaged, or something else")
        raw = path.read_bytes()
    except FileNotFoundError:
        raise ManifestUnreadable(f"there is no {MANIFEST} in {folder}; name a folder that was exported") from None
    except OSError as error:
        raise ManifestUnreadable(f"{path} cannot be read: {error.strerror or error}") from None
    damaged = ManifestUnreadable(f"{path} is damaged: it is not what was written, so the files cannot be checked by it")
    try:
        content: dict[str, Any] = json.loads(raw)
        sound = (
            isinstance(content, dict) and json_bytes(content) == raw and content.get(_OWN_HASH) == _own_hash(content)
        )
    except (ValueError, RecursionError):
        raise damaged from None
    if not sound:
        raise damaged
    if content.get("manifest_version") != MANIFEST_VERSION:
        raise ManifestUnreadable(f"{path} was written by another version of the service; verify it with that one")
    files = content.get("files")
    if not isinstance(files, dict) or not all(_is_entry(name, said) for name, said in files.items()):
        raise damaged
    return content


def _is_entry(name: str, said: Any) -> bool:
    """A bare file name, its size and its hash: a manifest must not lead out of its folder."""
    if re.fullmatch(r"[^/\\\x00]{1,255}", name) is None or name in (".", "..", MANIFEST) or not isinstance(said, dict):
        return False
    return isinstance(said.get("bytes"), int) and re.fullmatch(r"[0-9a-f]{64}", str(said.get("sha256"))) is not None


def _own_hash(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json_bytes({name: value for name, value in content.items() if name != _OWN_HASH})).hexdigest()
