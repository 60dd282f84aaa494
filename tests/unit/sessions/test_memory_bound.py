"""The points that an export holds at once follow from the memory that it may take."""

from scanner_service.sessions.memory_bound import (
    BYTES_A_POINT,
    FIXED_BYTES,
    LEAST_POINTS,
    MOST_POINTS,
    available_bytes,
    left_to_group_bytes,
    points_at_once,
)


def test_what_is_held_at_once_fits_into_the_memory_given():
    for memory_bytes in (1 << 30, 3 << 30, 40 << 30):
        points = points_at_once(memory_bytes)
        assert FIXED_BYTES + points * BYTES_A_POINT <= memory_bytes < FIXED_BYTES + (points + 1) * BYTES_A_POINT
    assert points_at_once(1) == LEAST_POINTS
    assert LEAST_POINTS <= points_at_once() <= MOST_POINTS


def test_free_memory_is_what_the_system_says_or_unknown(tmp_path):
    said = tmp_path / "meminfo"
    said.write_text("MemTotal:       8000000 kB\nMemAvailable:   4000000 kB\n")
    assert available_bytes(said) == 4_096_000_000
    for nonsense in ("", "MemAvailable:\n", "MemAvailable: many kB\n"):
        said.write_text(nonsense)
        assert available_bytes(said) is None
    assert available_bytes(tmp_path / "absent") is None


def test_a_container_is_told_what_its_own_limit_leaves(tmp_path):
    own, groups = tmp_path / "cgroup", tmp_path / "groups"
    inner = groups / "system.slice" / "scanner.service"
    inner.mkdir(parents=True)
    own.write_text("4:memory:/elsewhere\n0::/system.slice/scanner.service\n")
    assert left_to_group_bytes(own, groups) is None, "no group has a limit"
    for folder, most, used, idle in ((inner, "max", 900, 100), (inner.parent, "2000", 1500, 300)):
        (folder / "memory.max").write_text(f"{most}\n")
        (folder / "memory.current").write_text(f"{used}\n")
        (folder / "memory.stat").write_text(f"anon 5\ninactive_file {idle}\n")
    assert left_to_group_bytes(own, groups) == 800
    (inner / "memory.max").write_text("1000\n")
    assert left_to_group_bytes(own, groups) == 200
    (inner / "memory.max").write_text("much\n")
    assert left_to_group_bytes(own, groups) == 800
    assert left_to_group_bytes(tmp_path / "absent", groups) is None
