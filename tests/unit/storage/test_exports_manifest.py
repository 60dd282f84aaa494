"""A manifest finds every change of every file, its own included, and leads nowhere else."""

import json
import random

import pytest

from scanner_service.storage.exports.errors import ManifestUnreadable
from scanner_service.storage.exports.manifest import MANIFEST, sha256_of, verify_folder, write_manifest
from scanner_service.storage.exports.results_json import json_bytes

FACTS = {"software": "scanner-service 9.9.9", "settings": {"noise_mm": 0.01}, "raw_sha256": "ab" * 32}


def exported(folder):
    (folder / "points.ply").write_bytes(random.Random(1).randbytes(5000))
    (folder / "empty.csv").write_bytes(b"")
    return write_manifest(folder, ["points.ply", "empty.csv"], FACTS)


def test_what_was_written_is_sound_and_other_files_are_named(tmp_path):
    content = exported(tmp_path)
    (tmp_path / "mine.txt").write_text("a note")
    found = verify_folder(tmp_path)
    assert (set(found.sound), found.problems, found.unlisted) == ({"points.ply", "empty.csv"}, (), ("mine.txt",))
    assert found.manifest == content == json.loads((tmp_path / MANIFEST).read_text())
    assert content["files"]["empty.csv"]["sha256"] == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    assert content | FACTS == content


def flips(count, folder, rng):
    """So many single flipped bits, anywhere in any file of the folder; the folder is whole again after each."""
    paths = [path for path in sorted(folder.iterdir()) if path.stat().st_size]
    for _ in range(count):
        path = rng.choice(paths)
        whole = path.read_bytes()
        at = rng.randrange(8 * len(whole))
        damaged = bytearray(whole)
        damaged[at // 8] ^= 1 << at % 8
        path.write_bytes(damaged)
        yield path.name
        path.write_bytes(whole)


def silent(count, folder):
    """How many of so many flipped bits nobody notices."""
    exported(folder)
    unnoticed = 0
    for name in flips(count, folder, random.Random(2)):
        try:
            found = verify_folder(folder)
            unnoticed += not any(name in problem for problem in found.problems)
        except ManifestUnreadable:
            assert name == MANIFEST
    assert verify_folder(folder).problems == ()
    return unnoticed


def test_no_flipped_bit_is_silent(tmp_path):
    assert silent(500, tmp_path) == 0


@pytest.mark.long
def test_of_ten_thousand_flipped_bits_none_is_silent(tmp_path):
    assert silent(10_000, tmp_path) == 0


def test_files_that_are_gone_cut_or_replaced_are_told_by_name(tmp_path):
    exported(tmp_path)
    (tmp_path / "points.ply").write_bytes(b"short")
    (tmp_path / "empty.csv").unlink()
    (tmp_path / "empty.csv").symlink_to(tmp_path / "points.ply")
    assert verify_folder(tmp_path).problems == (
        "empty.csv is no ordinary file",
        "points.ply has 5 bytes, 5000 were written",
    )
    (tmp_path / "empty.csv").unlink()
    assert "empty.csv is gone" in verify_folder(tmp_path).problems


def signed(content):
    import hashlib

    rest = {name: value for name, value in content.items() if name != "sha256_of_the_rest"}
    return json_bytes(rest | {"sha256_of_the_rest": hashlib.sha256(json_bytes(rest)).hexdigest()})


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "a/b", "..", ".", "", "manifest.json", "a\\b", "a\0b"])
def test_a_manifest_cannot_lead_out_of_its_folder(tmp_path, name):
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "secret").write_bytes(b"x")
    said = {"bytes": 1, "sha256": sha256_of(tmp_path / "secret")}
    (folder / MANIFEST).write_bytes(signed({"manifest_version": 1, "files": {name: said}}))
    with pytest.raises(ManifestUnreadable, match="damaged"):
        verify_folder(folder)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{}",
        b"[]",
        b"null",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"files": {}}',
        signed({"files": {}}),
        b"1" * 5_000_000,
    ],
    ids=range(9),
)
def test_what_is_no_manifest_is_told_so(tmp_path, content):
    (tmp_path / MANIFEST).write_bytes(content)
    with pytest.raises(ManifestUnreadable):
        verify_folder(tmp_path)


def test_a_folder_without_a_manifest_is_told_so(tmp_path):
    for folder in (tmp_path, tmp_path / "absent"):
        with pytest.raises(ManifestUnreadable, match="there is no manifest"):
            verify_folder(folder)
