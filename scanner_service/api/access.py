"""Who is asking: keys, one-time logins and browser sessions become an identity with a role; knows no route.

Errors:

    AccessError
      NotAuthenticated      nothing was shown that says who asks
        KeyMistyped         the key's checksum does not fit
        KeyUnknown          a sound key, but none of this service's
        LoginEnded          the cookie is of no login, or of one that ended
        LoginUnknown        the one-time login was used, is too old, or never existed
      RoleTooLow            known, but may not do this

Browser sessions and one-time logins live in memory, hashed; a restart ends them.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

from starlette.requests import HTTPConnection
from starlette.responses import Response

from scanner_service.api import keys as keyring
from scanner_service.api.keys import Entropy, Role, StoredKey
from scanner_service.api.problems import Problem

LOGIN_LIFETIME_S = 600.0
SESSION_LIFETIME_S = 12 * 3600.0
MAX_SESSIONS = 1000
LOCAL_LABEL = "this machine"
COOKIE_NAME = "scanner_session"
BEARER_SUBPROTOCOL = "bearer."


class AccessError(Exception):
    """A request may not do what it asks; see the tree above."""


class NotAuthenticated(AccessError):
    """Nothing was shown that says who asks."""


class KeyMistyped(NotAuthenticated):
    """The key's checksum does not fit."""


class KeyUnknown(NotAuthenticated):
    """A sound key, but none of this service's."""


class LoginEnded(NotAuthenticated):
    """The cookie is of no login, or of one that ended."""


class LoginUnknown(NotAuthenticated):
    """The one-time login was used, is too old, or never existed."""


class RoleTooLow(AccessError):
    """Known, but may not do this."""


_CHALLENGE = {"WWW-Authenticate": 'Bearer realm="scanner"'}
ACCESS_PROBLEMS: dict[type[Exception], Problem] = {
    NotAuthenticated: Problem(401, "not-authenticated", "Say who you are", _CHALLENGE),
    KeyMistyped: Problem(401, "key-mistyped", "The key is mistyped", _CHALLENGE),
    KeyUnknown: Problem(401, "key-unknown", "The key is not known here", _CHALLENGE),
    LoginEnded: Problem(401, "login-ended", "Log in again", _CHALLENGE),
    LoginUnknown: Problem(401, "login-unknown", "The one-time address is not valid", _CHALLENGE),
    RoleTooLow: Problem(403, "role-too-low", "Your role may not do this"),
}


@dataclass(frozen=True, slots=True)
class Identity:
    """Who asks: the role, a name to show and log (`label`), and how it was shown (`key` or `cookie`).

    `credential_sha256` is the hash of what was shown: `Access.still_holds` tells whether it is good still.
    """

    role: Role
    label: str
    means: str
    credential_sha256: str = field(default="", repr=False, compare=False)


@dataclass(frozen=True, slots=True)
class _Lent:
    """A login or session held in memory until `expires_s` of the clock."""

    role: Role
    label: str
    expires_s: float


class Access:
    """The keys of a data directory and the browser sessions of this process; safe to use from several threads.

    `refusals` counts what was refused, by the name of the error.
    """

    def __init__(self, data_dir: Path, keys: tuple[StoredKey, ...], clock: Callable[[], float], rng: Entropy) -> None:
        self.refusals: Counter[str] = Counter()
        self._data_dir = data_dir
        self._keys = keys
        self._clock = clock
        self._rng = rng
        self._logins: dict[str, _Lent] = {}
        self._sessions: dict[str, _Lent] = {}
        self._lock = Lock()

    @classmethod
    def open(cls, data_dir: Path, clock: Callable[[], float], rng: Entropy) -> "Access":
        """Read the keys; at the first start make the directory and an admin key for this machine's own commands.

        Parameters
        ----------
        clock : seconds that never run backwards (in service `time.monotonic`); nothing of it is stored.
        rng : n -> n random bytes (in service `secrets.token_bytes`).

        Raises
        ------
        KeyFileExposed, KeyFileDamaged : from `keys`; a service with doubtful keys does not start.
        """
        data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        access = cls(data_dir, keyring.load_keys(data_dir), clock, rng)
        local = keyring.read_local_key(data_dir)
        if local is None or keyring.find(access._keys, local) is None:
            access._renew_local_key()
        return access

    def _renew_local_key(self) -> None:
        key = keyring.make_key(self._rng)
        kept = tuple(stored for stored in self._keys if stored.label != LOCAL_LABEL)
        self._keys = (*kept, StoredKey(Role.ADMIN, LOCAL_LABEL, keyring.sha256_of(key)))
        keyring.save_keys(self._data_dir, self._keys)
        keyring.save_local_key(self._data_dir, key)

    @property
    def keys(self) -> tuple[StoredKey, ...]:
        """The keys as they are stored."""
        return self._keys

    def create_key(self, role: Role, label: str) -> str:
        """A new key, to be shown once: only its hash is kept.

        Raises
        ------
        ValueError : when the label is empty, not ASCII or the one kept for this machine.
        """
        if not label or not label.isascii() or not label.isprintable() or label == LOCAL_LABEL:
            raise ValueError(f"{label!r} cannot name a key; use a short printable ASCII name of your own")
        with self._lock:
            key = keyring.make_key(self._rng)
            changed = (*self._keys, StoredKey(role, label, keyring.sha256_of(key)))
            keyring.save_keys(self._data_dir, changed)  # first the file: a key that is not kept is never handed out
            self._keys = changed
        return key

    def revoke_key(self, key_id: str) -> bool:
        """Forget a key; False when there is none of that id. Browser sessions opened with it end as well."""
        with self._lock:
            gone = [stored for stored in self._keys if stored.key_id == key_id]
            changed = tuple(stored for stored in self._keys if stored.key_id != key_id)
            if not gone:
                return False
            keyring.save_keys(self._data_dir, changed)
            self._keys = changed
            labels = {stored.label for stored in gone}
            self._sessions = {name: lent for name, lent in self._sessions.items() if lent.label not in labels}
        return True

    def identify_key(self, key: str) -> Identity:
        """Whose key this is.

        Raises
        ------
        KeyMistyped, KeyUnknown
        """
        if not keyring.is_well_formed(key):
            raise self._refused(
                KeyMistyped("The key is mistyped or cut off: its checksum does not fit. Copy it again.")
            )
        stored = keyring.find(self._keys, key)
        if stored is None:
            raise self._refused(KeyUnknown("The key is not known here; ask an admin of this service for one."))
        return Identity(stored.role, stored.label, "key", stored.sha256)

    def issue_login(self, role: Role = Role.ADMIN, label: str = LOCAL_LABEL) -> str:
        """A token for one login within ten minutes, to be put into an address that a person opens."""
        token = self._rng(32).hex()
        with self._lock:
            self._prune()
            self._logins[keyring.sha256_of(token)] = _Lent(role, label, self._clock() + LOGIN_LIFETIME_S)
        return token

    def redeem_login(self, token: str) -> str:
        """Use up a one-time login; the value of a new session's cookie.

        Raises
        ------
        LoginUnknown
        """
        with self._lock:
            self._prune()
            lent = self._logins.pop(keyring.sha256_of(token), None)
        if lent is None:
            raise self._refused(
                LoginUnknown("The one-time address was used already or is older than ten minutes; run: scanner open")
            )
        return self.open_session(lent.role, lent.label)

    def open_session(self, role: Role, label: str) -> str:
        """The value of a new browser session's cookie; when there are too many, the oldest session ends."""
        value = self._rng(32).hex()
        with self._lock:
            self._prune()
            while len(self._sessions) >= MAX_SESSIONS:
                del self._sessions[next(iter(self._sessions))]
            self._sessions[keyring.sha256_of(value)] = _Lent(role, label, self._clock() + SESSION_LIFETIME_S)
        return value

    def close_session(self, value: str) -> None:
        """End a browser session; nothing happens when there is none."""
        with self._lock:
            self._sessions.pop(keyring.sha256_of(value), None)

    def identify_session(self, value: str) -> Identity:
        """Whose cookie this is.

        Raises
        ------
        LoginEnded
        """
        with self._lock:
            lent = self._sessions.get(keyring.sha256_of(value))
        if lent is None or lent.expires_s <= self._clock():
            raise self._refused(LoginEnded("The login of this browser has ended; log in again."))
        return Identity(lent.role, lent.label, "cookie", keyring.sha256_of(value))

    def still_holds(self, identity: Identity) -> bool:
        """True until the key is revoked, or the browser's login ends: what was opened with it must end too."""
        if identity.means == "key":
            return any(stored.sha256 == identity.credential_sha256 for stored in self._keys)
        with self._lock:
            lent = self._sessions.get(identity.credential_sha256)
        return lent is not None and lent.expires_s > self._clock()

    def identify(self, connection: HTTPConnection) -> Identity:
        """Who sent a request or asks for a WebSocket; to be called before it is accepted.

        A key in the Authorization header counts first, then one in a WebSocket's subprotocols (`bearer.KEY`, for
        browsers, which cannot set headers there), then the cookie. What is shown and wrong is refused: nothing
        falls through to the next.

        Raises
        ------
        NotAuthenticated, or one of its kinds
        """
        authorization = connection.headers.getlist("authorization")
        if authorization:
            return self.identify_key(self._bearer(authorization))
        for name in connection.scope.get("subprotocols", ()):
            if name.startswith(BEARER_SUBPROTOCOL):
                return self.identify_key(name.removeprefix(BEARER_SUBPROTOCOL))
        value = connection.cookies.get(cookie_name(connection))
        if value is None:
            raise self._refused(
                NotAuthenticated("Send a key (Authorization: Bearer KEY), or open the one-time address: scanner open")
            )
        return self.identify_session(value)

    def authorise(self, identity: Identity, needed: Role) -> None:
        """Pass when the identity's role is enough.

        Raises
        ------
        RoleTooLow
        """
        if identity.role < needed:
            raise self._refused(
                RoleTooLow(f"This needs the role {needed.name.lower()}; yours is {identity.role.name.lower()}.")
            )

    def _bearer(self, headers: list[str]) -> str:
        scheme, _, key = headers[0].partition(" ")
        if len(headers) != 1 or scheme.lower() != "bearer" or not key:
            raise self._refused(NotAuthenticated("Send one header: Authorization: Bearer KEY."))
        return key.strip()

    def _refused(self, error: AccessError) -> AccessError:
        self.refusals[type(error).__name__] += 1
        return error

    def _prune(self) -> None:
        now_s = self._clock()
        self._logins = {name: lent for name, lent in self._logins.items() if lent.expires_s > now_s}
        self._sessions = {name: lent for name, lent in self._sessions.items() if lent.expires_s > now_s}


def cookie_name(connection: HTTPConnection) -> str:
    """The cookie's name; browsers send cookies to every port of a host, so it names the port.

    Over TLS it has the prefix by which browsers refuse it from anyone but this very host (`__Host-`).
    """
    server = connection.scope.get("server")
    port = server[1] if server else None
    return f"{'__Host-' if _is_tls(connection) else ''}{COOKIE_NAME}_{port or 0}"


def set_session_cookie(response: Response, connection: HTTPConnection, value: str) -> None:
    """Hand a session to the browser: no script reads it, no other site's page sends it."""
    response.set_cookie(
        cookie_name(connection),
        value,
        max_age=int(SESSION_LIFETIME_S),
        path="/",
        secure=_is_tls(connection),
        httponly=True,
        samesite="strict",
    )


def clear_session_cookie(response: Response, connection: HTTPConnection) -> None:
    """Take the session back from the browser."""
    name = cookie_name(connection)
    response.delete_cookie(name, path="/", secure=_is_tls(connection), httponly=True, samesite="strict")


def _is_tls(connection: HTTPConnection) -> bool:
    return connection.scope["scheme"] in {"https", "wss"}
