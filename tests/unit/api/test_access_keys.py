"""Laws of keys and of the files that hold them."""

import stat
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.api.access import Access, KeyMistyped, KeyUnknown, LoginEnded, LoginUnknown
from scanner_service.api.keys import (
    KEYS_FILE,
    LOCAL_KEY_FILE,
    KeyFileDamaged,
    KeyFileExposed,
    Role,
    is_well_formed,
    make_key,
    read_local_key,
)
from tests.unit.api.small_service import Clock

ALPHABET = "abcdefghijklmnopqrstuvwxyz234567"
KEYS = st.binary(min_size=32, max_size=32).map(lambda secret: make_key(lambda count: secret))


def opened(data_dir: Path, clock: Clock | None = None, seed: int = 1) -> Access:
    return Access.open(data_dir, clock or Clock(), Random(seed).randbytes)


@given(KEYS)
def test_a_key_is_well_formed_and_carries_256_bits(key: str) -> None:
    assert is_well_formed(key)
    assert key.startswith("scn_")
    assert len(key) == 4 + 52 + 7  # 52 characters of 5 bits hold 256 bits, 7 hold the 32 of the checksum


@given(KEYS, st.integers(0, 62), st.sampled_from([*ALPHABET, "A", "0", " ", "é"]))
def test_one_wrong_character_anywhere_is_recognised_without_any_file(key: str, at: int, wrong: str) -> None:
    mistyped = key[:at] + wrong + key[at + 1 :]
    assert is_well_formed(mistyped) == (mistyped == key)


@given(KEYS, st.integers(0, 61))
def test_two_neighbours_swapped_are_recognised(key: str, at: int) -> None:
    swapped = key[:at] + key[at + 1] + key[at] + key[at + 2 :]
    assert is_well_formed(swapped) == (swapped == key)


@given(KEYS, st.integers(0, 62))
def test_a_key_cut_off_or_continued_is_recognised(key: str, length: int) -> None:
    assert not is_well_formed(key[:length])
    assert not is_well_formed(key + "a")


def test_the_first_start_makes_an_admin_key_for_this_machine_that_only_the_owner_reads(tmp_path: Path) -> None:
    access = opened(tmp_path / "data")
    key = read_local_key(tmp_path / "data")
    assert key is not None
    assert access.identify_key(key).role is Role.ADMIN
    for name in [KEYS_FILE, LOCAL_KEY_FILE]:
        assert stat.S_IMODE((tmp_path / "data" / name).stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "data").stat().st_mode) == 0o700


def test_the_file_of_the_keys_holds_no_key(tmp_path: Path) -> None:
    access = opened(tmp_path)
    keys = [access.create_key(role, f"a {role.name}") for role in Role]
    stored = (tmp_path / KEYS_FILE).read_text()
    for key in [*keys, read_local_key(tmp_path) or "-"]:
        assert key not in stored
        assert key[4:56] not in stored


def test_keys_outlive_a_restart_with_their_roles(tmp_path: Path) -> None:
    first = opened(tmp_path)
    keys = {role: first.create_key(role, f"a {role.name}") for role in Role}
    local = read_local_key(tmp_path)
    again = opened(tmp_path, seed=2)
    assert {role: again.identify_key(key).role for role, key in keys.items()} == {role: role for role in Role}
    assert read_local_key(tmp_path) == local


def test_a_lost_local_key_is_replaced_and_no_longer_valid(tmp_path: Path) -> None:
    opened(tmp_path)
    lost = read_local_key(tmp_path) or ""
    (tmp_path / LOCAL_KEY_FILE).unlink()
    again = opened(tmp_path, seed=2)
    with pytest.raises(KeyUnknown):
        again.identify_key(lost)
    assert again.identify_key(read_local_key(tmp_path) or "").role is Role.ADMIN
    assert len(again.keys) == 1


def test_a_revoked_key_and_its_browser_sessions_end(tmp_path: Path) -> None:
    access = opened(tmp_path)
    key = access.create_key(Role.OPERATOR, "cell 3")
    session = access.open_session(Role.OPERATOR, "cell 3")
    key_id = next(stored.key_id for stored in access.keys if stored.label == "cell 3")
    assert access.revoke_key(key_id)
    assert not access.revoke_key(key_id)
    with pytest.raises(KeyUnknown):
        access.identify_key(key)
    with pytest.raises(LoginEnded):
        access.identify_session(session)
    with pytest.raises(KeyUnknown):
        opened(tmp_path, seed=2).identify_key(key)


def test_an_unknown_key_is_told_from_a_mistyped_one_and_both_are_counted(tmp_path: Path) -> None:
    access = opened(tmp_path)
    stranger = make_key(Random(99).randbytes)
    with pytest.raises(KeyUnknown):
        access.identify_key(stranger)
    with pytest.raises(KeyMistyped):
        access.identify_key(stranger[:-1])
    assert access.refusals == {"KeyUnknown": 1, "KeyMistyped": 1}


@pytest.mark.parametrize("name", [KEYS_FILE, LOCAL_KEY_FILE])
def test_a_file_that_others_may_read_keeps_the_service_from_starting(tmp_path: Path, name: str) -> None:
    opened(tmp_path)
    (tmp_path / name).chmod(0o640)
    with pytest.raises(KeyFileExposed, match="chmod 600"):
        opened(tmp_path)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"keys": 3}', '{"keys": [{"role": "king", "label": "x", "sha256": "00"}]}', '{"keys": [3]}'],
)
def test_a_damaged_file_of_keys_is_an_error_and_is_left_as_it_is(tmp_path: Path, text: str) -> None:
    opened(tmp_path)
    (tmp_path / KEYS_FILE).write_text(text)
    with pytest.raises(KeyFileDamaged, match=r"keys\.json"):
        opened(tmp_path)
    assert (tmp_path / KEYS_FILE).read_text() == text


def test_a_local_key_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    opened(tmp_path)
    (tmp_path / LOCAL_KEY_FILE).rename(tmp_path / "elsewhere")
    (tmp_path / LOCAL_KEY_FILE).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(KeyFileDamaged):
        read_local_key(tmp_path)


@pytest.mark.parametrize("label", ["", "this machine", "käse", "a\nb"])
def test_a_label_that_would_mislead_is_refused(tmp_path: Path, label: str) -> None:
    with pytest.raises(ValueError, match="cannot name a key"):
        opened(tmp_path).create_key(Role.VIEWER, label)


def test_a_one_time_login_works_once_and_for_ten_minutes(tmp_path: Path) -> None:
    clock = Clock()
    access = opened(tmp_path, clock)
    token, late = access.issue_login(), access.issue_login(Role.VIEWER)
    clock.now_s += 599.0
    assert access.identify_session(access.redeem_login(token)).role is Role.ADMIN
    with pytest.raises(LoginUnknown):
        access.redeem_login(token)
    clock.now_s += 1.0
    with pytest.raises(LoginUnknown):
        access.redeem_login(late)


def test_a_browser_session_ends_after_twelve_hours_and_at_logout(tmp_path: Path) -> None:
    clock = Clock()
    access = opened(tmp_path, clock)
    one, other = access.open_session(Role.VIEWER, "x"), access.open_session(Role.VIEWER, "x")
    access.close_session(other)
    with pytest.raises(LoginEnded):
        access.identify_session(other)
    clock.now_s += 12 * 3600.0 - 1.0
    assert access.identify_session(one).role is Role.VIEWER
    clock.now_s += 1.0
    with pytest.raises(LoginEnded):
        access.identify_session(one)


def test_sessions_are_bounded_and_the_oldest_ends_first(tmp_path: Path) -> None:
    access = opened(tmp_path)
    values = [access.open_session(Role.VIEWER, "x") for _ in range(1001)]
    with pytest.raises(LoginEnded):
        access.identify_session(values[0])
    assert access.identify_session(values[1]).label == "x"


def test_neither_tokens_nor_cookies_are_held_in_the_clear(tmp_path: Path) -> None:
    access = opened(tmp_path)
    token, value = access.issue_login(), access.open_session(Role.VIEWER, "x")
    held = repr(vars(access))
    assert token not in held
    assert value not in held
