"""`scanner open`: a fresh one-time address of the viewer of a running service."""

import webbrowser
from typing import Annotated

import httpx
import typer

from scanner_service.api.keys import read_local_key
from scanner_service.commands.data_folder import DEFAULT_DATA, Data
from scanner_service.commands.terminal import console, fail, plain_errors, show_json


def open_command(
    data: Data = DEFAULT_DATA,
    url: Annotated[str, typer.Option(help="Where the service listens.")] = "http://127.0.0.1:8765",
    browse: Annotated[bool, typer.Option(help="Open a browser too.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print the address as JSON.")] = False,
) -> None:
    """Print a one-time address of the viewer, and open it in a browser."""
    with plain_errors():
        key = read_local_key(data)
        if key is None:
            fail(f"there is no key in {data}: start `scanner serve` first, or name its folder with --data")
        try:
            answer = httpx.post(f"{url}/api/v1/login-url", headers={"Authorization": f"Bearer {key}"}, timeout=10.0)
        except httpx.HTTPError as error:
            fail(f"no service answers at {url} ({error}): start it with `scanner serve`, or say --url")
        if answer.is_error:
            fail(f"the service at {url} refused: {answer.json().get('detail', answer.status_code)}")
        address = url + answer.json()["path"]
        if as_json:
            show_json({"viewer": address})
        else:
            console.print(address, soft_wrap=True, highlight=False)
        if browse and not as_json:
            webbrowser.open(address)
