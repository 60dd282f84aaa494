"""Reads Host and Origin headers, and says which are this service's own; never looks at a URL or a name server."""

import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass, field

DEFAULT_PORTS = {"http": 80, "https": 443, "ws": 80, "wss": 443}
LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "[::1]"})

# Labels of letters, digits, hyphen and underscore; no trailing dot, no user part, no space.
_NAME = re.compile(r"[a-z0-9_](?:[a-z0-9_-]{0,61}[a-z0-9_])?(?:\.[a-z0-9_](?:[a-z0-9_-]{0,61}[a-z0-9_])?)*")
_AUTHORITY = re.compile(r"(?P<host>\[[0-9a-f:.]{2,45}\]|[a-z0-9_.-]{1,253})(?::(?P<port>[0-9]{1,5}))?")


@dataclass(frozen=True, slots=True)
class Authority:
    """A host and a port: `host` in lower case, IPv6 in brackets and in its shortest form."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str, default_port: int) -> "Authority | None":
        """The authority a Host header names, or None when it names none (RFC 9110 section 7.2)."""
        match = _AUTHORITY.fullmatch(text.lower())
        if match is None:
            return None
        host = _canonical_host(match["host"])
        port = int(match["port"]) if match["port"] else default_port
        return cls(host, port) if host and 0 < port < 65536 else None


@dataclass(frozen=True, slots=True)
class Origin:
    """Scheme, host and port of a page (RFC 6454)."""

    scheme: str
    authority: Authority

    @classmethod
    def parse(cls, text: str) -> "Origin | None":
        """The origin an Origin header names; None for `null`, for paths and for anything that is not one."""
        scheme, separator, rest = text.partition("://")
        scheme = scheme.lower()
        if not separator or scheme not in {"http", "https"}:
            return None
        authority = Authority.parse(rest, DEFAULT_PORTS[scheme])
        return cls(scheme, authority) if authority else None


def _canonical_host(host: str) -> str | None:
    if host.startswith("["):
        try:
            return f"[{ipaddress.IPv6Address(host[1:-1]).compressed}]"
        except ValueError:
            return None
    return host if _NAME.fullmatch(host) else None


@dataclass(frozen=True, slots=True)
class Allowlist:
    """The names this service answers to, besides the loopback names with the port it listens on.

    `hosts` are `name` or `name:port` as in a Host header; `origins` are `scheme://name[:port]` as a browser sends
    them, for pages served elsewhere and for a proxy that ends TLS. Without a port the scheme's default is meant.

    Raises
    ------
    ValueError : when an entry is neither; an entry that can never match would be a silent mistake.
    """

    hosts: frozenset[str] = frozenset()
    origins: frozenset[str] = frozenset()
    _origins: frozenset[Origin] = field(init=False)

    def __post_init__(self) -> None:
        for host in self.hosts:
            if Authority.parse(host, 80) is None:
                raise ValueError(f"{host!r} is not a host; write NAME or NAME:PORT, without a scheme")
        object.__setattr__(self, "_origins", frozenset(_origins_of(self.origins)))

    def allows_host(self, host: Authority, scheme: str, listening_port: int | None) -> bool:
        """True when a request that names `host`, taken on `listening_port` with `scheme`, is meant for us."""
        if host.host in LOOPBACK_NAMES and listening_port == host.port:
            return True
        return any(Authority.parse(entry, DEFAULT_PORTS[scheme]) == host for entry in self.hosts)

    def allows_origin(self, origin: Origin, host: Authority, scheme: str) -> bool:
        """True when a page of `origin` may change things here: its own page, or one that is configured."""
        own = Origin({"ws": "http", "wss": "https"}.get(scheme, scheme), host)
        return origin == own or origin in self._origins


def _origins_of(entries: Iterable[str]) -> Iterable[Origin]:
    for entry in entries:
        origin = Origin.parse(entry)
        if origin is None:
            raise ValueError(f"{entry!r} is not an origin; write SCHEME://NAME or SCHEME://NAME:PORT, without a path")
        yield origin
