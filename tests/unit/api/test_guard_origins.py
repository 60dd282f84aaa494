"""Laws of reading Host and Origin."""

import ipaddress
import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.api.origins import DEFAULT_PORTS, LOOPBACK_NAMES, Allowlist, Authority, Origin

LABELS = st.from_regex(r"[a-z0-9]([a-z0-9-]{0,10}[a-z0-9])?", fullmatch=True)
NAMES = st.lists(LABELS, min_size=1, max_size=4).map(".".join)
IPV6 = st.ip_addresses(v=6).filter(lambda address: address.scope_id is None)  # type: ignore[union-attr]
HOSTS = st.one_of(NAMES, st.ip_addresses(v=4).map(str), IPV6.map(lambda address: f"[{address}]"))
PORTS = st.integers(1, 65535)


@given(HOSTS, PORTS, st.sampled_from(["http", "https"]))
def test_what_a_browser_sends_is_read_back(host: str, port: int, scheme: str) -> None:
    assert Authority.parse(f"{host}:{port}", 80) == Authority(host, port)
    assert Authority.parse(host.upper(), port) == Authority(host, port)
    assert Origin.parse(f"{scheme}://{host}:{port}") == Origin(scheme, Authority(host, port))
    assert Origin.parse(f"{scheme}://{host}") == Origin(scheme, Authority(host, DEFAULT_PORTS[scheme]))


@given(IPV6, PORTS)
def test_every_spelling_of_an_ipv6_address_is_one_host(address: ipaddress.IPv6Address, port: int) -> None:
    assert Authority.parse(f"[{address.exploded.upper()}]:{port}", 80) == Authority(f"[{address.compressed}]", port)


@given(HOSTS, PORTS, st.sampled_from(list(" /\\@?#,;\t\r\n\0%é")), st.integers(0, 60))
def test_no_other_character_is_taken_anywhere(host: str, port: int, foreign: str, at: int) -> None:
    text = f"{host}:{port}"
    at = min(at, len(text))
    broken = text[:at] + foreign + text[at:]
    assert Authority.parse(broken, 80) is None
    assert Origin.parse(f"http://{broken}") is None


@given(st.text(string.printable, max_size=40), PORTS)
def test_whatever_text_comes_only_loopback_names_with_our_port_are_ours(text: str, port: int) -> None:
    host = Authority.parse(text, 80)
    if host is not None and Allowlist().allows_host(host, "http", port):
        assert host.host in LOOPBACK_NAMES
        assert text.lower().endswith(f":{port}") or port == 80


@given(HOSTS, PORTS, HOSTS, PORTS, st.sampled_from(["http", "https", "ws", "wss"]))
def test_same_origin_is_equality_of_scheme_host_and_port(
    host: str, port: int, other: str, other_port: int, scheme: str
) -> None:
    page = Origin("https" if scheme in {"https", "wss"} else "http", Authority(other, other_port))
    same = (host, port) == (other, other_port)
    assert Allowlist().allows_origin(page, Authority(host, port), scheme) == same
    assert Allowlist().allows_origin(Origin(page.scheme, Authority(host, port)), Authority(host, port), scheme)
    swapped = Origin("http" if page.scheme == "https" else "https", Authority(host, port))
    assert not Allowlist().allows_origin(swapped, Authority(host, port), scheme)


@pytest.mark.parametrize(
    "text", ["", ":80", "a..b", ".a", "a.", "-a", "[::1", "::1", "[::1%eth0]", "a:0", "a:65536", "a:"]
)
def test_what_is_no_host_is_none(text: str) -> None:
    assert Authority.parse(text, 80) is None


@pytest.mark.parametrize("text", ["null", "file://", "http://", "http://a/", "ftp://a", "http:a", "//a", "a"])
def test_what_is_no_origin_is_none(text: str) -> None:
    assert Origin.parse(text) is None


def test_an_entry_that_could_never_match_is_refused() -> None:
    with pytest.raises(ValueError, match="not a host"):
        Allowlist(hosts=frozenset({"http://scan.example"}))
    with pytest.raises(ValueError, match="not an origin"):
        Allowlist(origins=frozenset({"scan.example"}))
