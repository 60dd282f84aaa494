"""Every parser, driver's half and simulated device survives any bytes; what the fuzzer found interesting, too."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.targets import CONVERSATIONS, DEVICES, PARSERS, TARGETS, seeds

CORPUS = Path(__file__).resolve().parents[2] / "fuzz" / "corpus"


def mixtures(name: str) -> st.SearchStrategy[bytes]:
    """Noise, and good frames cut, spliced and damaged: what plain noise would take for ever to reach."""
    good = st.sampled_from(seeds(name))
    cut = st.builds(lambda data, start, end: data[start:end], good, st.integers(0, 40), st.integers(0, 900))
    return st.lists(st.binary(max_size=40) | good | cut, max_size=12).map(b"".join)


@pytest.mark.parametrize("name", PARSERS)
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_no_bytes_break_a_parser(name: str, data: st.DataObject) -> None:
    PARSERS[name](data.draw(mixtures(name)))


@pytest.mark.parametrize("name", CONVERSATIONS | DEVICES)
@given(data=st.data())
@settings(max_examples=4, deadline=None)
def test_no_bytes_break_a_conversation_or_a_device(name: str, data: st.DataObject) -> None:
    (CONVERSATIONS | DEVICES)[name](data.draw(mixtures(name)))


@pytest.mark.long
@pytest.mark.parametrize("name", TARGETS)
@given(data=st.data())
@settings(max_examples=1500, deadline=None)
def test_no_bytes_break_anything_at_length(name: str, data: st.DataObject) -> None:
    TARGETS[name](data.draw(mixtures(name)))


@pytest.mark.parametrize("name", PARSERS)
def test_what_the_fuzzer_kept_breaks_nothing(name: str) -> None:
    for case in sorted((CORPUS / name).glob("*")):
        PARSERS[name](case.read_bytes())
