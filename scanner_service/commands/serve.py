"""`scanner serve`: the service until it is told to stop."""

import json
from pathlib import Path
from typing import Annotated

import typer

from scanner_service.api.app import make_app
from scanner_service.api.login import login_url
from scanner_service.api.origins import Allowlist
from scanner_service.api.server import Listening, Tls, serve
from scanner_service.api.service import Service
from scanner_service.commands.data_folder import DEFAULT_DATA, Data
from scanner_service.commands.terminal import errors, plain_errors
from scanner_service.sessions.retention import Retention
from scanner_service.storage.rows import Limits

RECORD_HELP = (
    "Where the record is kept: a file, or postgresql://user@host/database; a file in the data folder by default."
)


def serve_command(
    data: Data = DEFAULT_DATA,
    host: Annotated[str, typer.Option(help="Address to listen on; other than loopback only with TLS.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 8765,
    certificate: Annotated[Path | None, typer.Option(help="TLS certificate chain (PEM).")] = None,
    private_key: Annotated[Path | None, typer.Option(help="TLS private key (PEM).")] = None,
    allow_host: Annotated[list[str] | None, typer.Option(help="A further name this service answers to.")] = None,
    allow_origin: Annotated[list[str] | None, typer.Option(help="A further origin whose pages may use it.")] = None,
    record: Annotated[str | None, typer.Option(envvar="SCANNER_RECORD", help=RECORD_HELP, show_envvar=True)] = None,
    keep_days: Annotated[
        float | None,
        typer.Option(envvar="SCANNER_KEEP_DAYS", help="Delete sessions older than this; never by default."),
    ] = None,
    disk_budget_gb: Annotated[
        float | None,
        typer.Option(
            envvar="SCANNER_DISK_BUDGET_GB",
            help="Gigabytes that stored lines may take; the oldest sessions are deleted for it. No limit by default.",
        ),
    ] = None,
    spool_mb: Annotated[
        float,
        typer.Option(envvar="SCANNER_SPOOL_MB", min=0.01, max=4096, help="Megabytes of lines kept while a disk fails."),
    ] = 64.0,
    as_json: Annotated[bool, typer.Option("--json", help="Say where it listens as one line of JSON.")] = False,
) -> None:
    """Run the service: REST, live stream and viewer."""
    with plain_errors():
        if (certificate is None) != (private_key is None):
            raise ValueError("--certificate and --private-key belong together: give both or neither")
        tls = Tls(certificate, private_key) if certificate is not None and private_key is not None else None
        allowlist = Allowlist(frozenset(allow_host or ()), frozenset(allow_origin or ()))
        budget_bytes = None if disk_budget_gb is None else round(disk_budget_gb * 1e9)
        service = Service.open(
            data, record, Retention(keep_days, budget_bytes), Limits(spool_bytes=round(spool_mb * 1e6))
        )

        def announce(listening: Listening) -> None:
            if as_json:
                print(
                    json.dumps({"url": listening.url, "viewer": login_url(service.access, listening.url)}), flush=True
                )
                return
            errors.print(f"Viewer: {login_url(service.access, listening.url)}", soft_wrap=True, highlight=False)
            errors.print(f"API:    {listening.url}/docs   (the viewer's address works once, for ten minutes)")

        try:
            serve(make_app(service, allowlist), host, port, tls=tls, on_bound=announce)
        finally:
            service.close()
