"""Starts the whole service again and again, quickly: everything is imported and compiled once, each service is a fork.

Reads a data folder a line; answers with the process number of the service on it, then with its end. The service itself
says on the same output where it listens, as `scanner serve --json` does, and is that command in all but the start.
"""

import json
import os
import signal
import sys
from pathlib import Path

from scanner_service.commands.serve import serve_command
from scanner_service.sessions.readiness import warm_up


def _serve(data: Path) -> None:
    """In the fork: the command, until it is killed."""
    log = os.open(data.with_name(data.name + ".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 2)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    serve_command(data, port=0, as_json=True)


def main() -> None:
    """Fork a service for each line of standard input."""
    warm_up()
    print(json.dumps({"ready": os.getpid()}), flush=True)
    for line in iter(sys.stdin.readline, ""):
        child = os.fork()
        if child == 0:
            status = 1
            try:
                _serve(Path(line.strip()))
                status = 0
            finally:
                os._exit(status)
        print(json.dumps({"started": child}), flush=True)
        _, status = os.waitpid(child, 0)
        ended = {"ended": child, "killed": os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL}
        print(json.dumps(ended), flush=True)


if __name__ == "__main__":
    main()
