"""A PostgreSQL server of the tests' own, from Debian's package when it is installed: private, on a socket only."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOTS = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: -int(path.parent.name))


def missing() -> str:
    """Empty when a server can be started here, else why not."""
    if not ROOTS or not (ROOTS[0] / "initdb").exists():
        return "PostgreSQL is not installed (Debian: apt-get install postgresql)"
    try:
        import psycopg  # noqa: F401
    except ImportError:
        return "the driver psycopg is not installed"
    return ""


class Server:
    """One server, and databases in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._user = "postgres" if os.geteuid() == 0 else None  # the server refuses to run as root
        self._databases = 0
        if self._user is not None:
            shutil.chown(folder, self._user)
        self._run(
            "initdb", "-N", "-D", str(folder / "data"), "-U", "scanner", "-A", "trust", "-E", "UTF8", "--locale=C.UTF-8"
        )

    def start(self, *settings: str) -> None:
        """Start it, with settings `name=value`."""
        options = f"-c listen_addresses= -c unix_socket_directories={self.folder} -c max_connections=60"
        options += "".join(f" -c {setting}" for setting in settings)
        log = str(self.folder / "log")
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-w", "-t", "60", "-l", log, "-o", options, "start")

    def stop(self, mode: str = "fast") -> None:
        """Stop it; `immediate` is the death of the server: it recovers at the next start."""
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-w", "-t", "60", "-m", mode, "stop")

    def database(self) -> str:
        """The address of a new, empty database."""
        self._databases += 1
        name = f"record_{self._databases}"
        self.execute("postgres", f"CREATE DATABASE {name}")
        return self.address(name)

    def address(self, name: str) -> str:
        """The address of a database."""
        return f"postgresql://scanner@/{name}?host={self.folder}"

    def execute(self, name: str, statement: str) -> list[tuple]:
        """Do something with a connection of one's own."""
        import psycopg

        with psycopg.connect(f"host={self.folder} user=scanner dbname={name}", autocommit=True) as connection:
            cursor = connection.execute(statement)
            return cursor.fetchall() if cursor.description else []

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(ROOTS[0] / program), *arguments]
        done = subprocess.run(
            command, check=False, user=self._user, cwd=self.folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        assert done.returncode == 0, done.stderr.decode()


@contextmanager
def running_server() -> Iterator[Server]:
    """A server for the block."""
    with tempfile.TemporaryDirectory(prefix="postgres-") as folder:
        server = Server(Path(folder))
        server.start()
        try:
            yield server
        finally:
            server.stop("immediate")
