"""Laws of the look through JSON before it is parsed."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.api.json_limits import MAX_DEPTH, JsonRefused, check_json

LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.sampled_from(["NaN", "[[[{", '"Infinity\\'])
)
VALUES = st.recursive(
    LEAVES, lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(), inner)), max_leaves=30
)


def depth(value: object) -> int:
    if isinstance(value, dict):
        return 1 + max((depth(item) for item in value.values()), default=0)
    if isinstance(value, list):
        return 1 + max((depth(item) for item in value), default=0)
    return 0


def all_finite(value: object) -> bool:
    if isinstance(value, dict):
        return all(all_finite(item) for item in value.values())
    if isinstance(value, list):
        return all(all_finite(item) for item in value)
    return not isinstance(value, float) or math.isfinite(value)


@given(VALUES, st.integers(0, 6), st.booleans())
def test_exactly_the_finite_values_within_the_depth_are_let_through(
    value: object, limit: int, ascii_only: bool
) -> None:
    body = json.dumps(value, ensure_ascii=ascii_only).encode("utf-8", "surrogatepass")
    good = all_finite(value) and depth(value) <= limit
    try:
        body.decode()
    except UnicodeDecodeError:
        good = False
    if good:
        check_json(body, limit)
    else:
        with pytest.raises(JsonRefused):
            check_json(body, limit)


@given(VALUES, st.sampled_from(["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be"]))
def test_json_in_another_encoding_is_refused_before_a_parser_would_guess_it(value: object, encoding: str) -> None:
    with pytest.raises(JsonRefused, match="UTF-8"):
        check_json(json.dumps(value).encode(encoding))


@given(st.binary(max_size=200), st.integers(0, 40))
def test_whatever_passes_gives_no_value_that_is_not_finite_or_too_deep(noise: bytes, at: int) -> None:
    seed = b'{"a": [1e5, "NaN", {"b": [-0.5]}], "c": 1e308}'
    body = seed[:at] + noise + seed[at:]
    try:
        check_json(body)
        value = json.loads(body)
    except (JsonRefused, ValueError):
        return
    assert all_finite(value)
    assert depth(value) <= MAX_DEPTH


@pytest.mark.parametrize("number", ["1e309", "-1E+400", "17.9e1000", "9" * 310, "0.1e0000310", "1" + "0" * 400 + "e5"])
def test_a_number_beyond_a_double_is_refused(number: str) -> None:
    with pytest.raises(JsonRefused, match="too large"):
        check_json(f'{{"x": {number}}}'.encode())


@pytest.mark.parametrize("number", ["1e308", "1e-999", "0e999", "0.1e309", "9" * 308, "1" + "0" * 308])
def test_a_number_that_fits_a_double_is_not(number: str) -> None:
    assert math.isfinite(float(number))
    check_json(f'{{"x": {number}}}'.encode())


@pytest.mark.parametrize(
    "bomb",
    [
        b"[" * 2**20,
        b'"' + b'\\"' * 2**19,
        b'{"a":' * 2**17,
        b"[]," * 2**18,
        b"1" * 2**20,
        b"1e" * 2**19,
        b'"' * 2**20,
        b"9" * 308 + b"," + b"9" * 2**20,
        b"1.1" * 2**18,
        b'"\\' * 2**19,
        b"[1e100" + b",1e100" * 2**17 + b"]",
    ],
    ids=lambda bomb: repr(bomb[:6]),
)
@pytest.mark.timeout(20)
def test_a_mebibyte_of_any_kind_is_judged(bomb: bytes) -> None:
    # The timeout stands for "linear": a scan that tries things twice takes hours on these.
    try:
        check_json(bomb)
    except JsonRefused as refused:
        assert refused.slug in {"json-depth", "json-not-finite"}
