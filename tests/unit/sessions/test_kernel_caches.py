"""Of the caches of kernels those go that nobody used for thirty days; never the own, never anything else."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from scanner_service.sessions.kernel_caches import UNUSED_S, mark_used, remove_unused

NOW_S = 2e9
OWN = "kernels-0123456789abcdef"


def folder(parent, name, age_s):
    made = parent / name
    (made / "part").mkdir(parents=True)
    (made / "part" / "kernel.nbi").write_bytes(b"kernel")
    os.utime(made, (NOW_S - age_s, NOW_S - age_s))
    return made


def unused(own):
    return remove_unused(own, lambda: NOW_S)


def test_only_caches_that_nobody_used_for_long_are_removed(tmp_path):
    own = folder(tmp_path, OWN, 10 * UNUSED_S)
    folder(tmp_path, "kernels-00000000000000aa", UNUSED_S + 1)
    folder(tmp_path, "kernels-00000000000000bb", UNUSED_S - 1)
    folder(tmp_path, "kernels-00000000000000cc.going-7", UNUSED_S + 1)  # whoever began was killed
    folder(tmp_path, "kernels-of-somebody-else", 10 * UNUSED_S)
    folder(tmp_path, "photos", 10 * UNUSED_S)
    elsewhere = folder(tmp_path / "elsewhere", "kernels-00000000000000dd", 10 * UNUSED_S)
    (tmp_path / "kernels-00000000000000ee").symlink_to(elsewhere)
    (tmp_path / "kernels-00000000000000ff").write_text("a file")
    before = {each.name for each in tmp_path.iterdir()}
    gone = unused(own)
    assert sorted(gone) == ["kernels-00000000000000aa", "kernels-00000000000000cc"]
    assert {each.name for each in tmp_path.iterdir()} == before - {
        "kernels-00000000000000aa",
        "kernels-00000000000000cc.going-7",
    }
    assert (elsewhere / "part" / "kernel.nbi").exists()


def test_a_cache_that_is_marked_as_used_stays(tmp_path):
    other = folder(tmp_path, "kernels-00000000000000aa", UNUSED_S + 1)
    mark_used(other)
    assert remove_unused(tmp_path / OWN) == []
    mark_used(tmp_path / "kernels-00000000000000bb")  # of a program that compiled nothing yet
    assert [each.name for each in tmp_path.iterdir()] == [other.name]


def test_beside_a_folder_that_the_user_chose_nothing_is_removed(tmp_path):
    folder(tmp_path, "kernels-00000000000000aa", 10 * UNUSED_S)
    assert unused(tmp_path / "my-cache") == []
    assert unused(tmp_path / "absent" / OWN) == []
    assert (tmp_path / "kernels-00000000000000aa").exists()


def test_programs_that_remove_at_once_remove_each_cache_once(tmp_path):
    for number in range(20):
        folder(tmp_path, f"kernels-{number:016x}", 2 * UNUSED_S)
    together = threading.Barrier(4)

    def at_once(_):
        together.wait()
        return unused(tmp_path / OWN)

    with ThreadPoolExecutor(4) as pool:
        gone = [name for names in pool.map(at_once, range(4)) for name in names]
    assert sorted(gone) == [f"kernels-{number:016x}" for number in range(20)]
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_removed_is_said_and_raises_nothing(tmp_path, monkeypatch, caplog):
    folder(tmp_path, "kernels-00000000000000aa", 2 * UNUSED_S)

    def refused(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("scanner_service.sessions.kernel_caches.shutil.rmtree", refused)
    assert unused(tmp_path / OWN) == []
    assert "cannot be removed: [Errno 13]" in caplog.text


@pytest.mark.parametrize("age_s", [0.0, UNUSED_S + 1])
def test_the_program_keeps_its_own_cache_through_its_start(tmp_path, age_s):
    own = folder(tmp_path, OWN, age_s)
    mark_used(own)
    assert unused(own) == []
    assert (own / "part" / "kernel.nbi").exists()
