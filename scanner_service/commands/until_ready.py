"""Waiting for a service that was just started and loads or compiles its kernels; says meanwhile how far that is."""

import time

import httpx

from scanner_service.commands.terminal import fail, waiting_for

SAID = "preparing kernels …"
_COMPILING_S = 600.0
_POLL_S, _ANSWER_S = 0.2, 5.0


def wait_until_ready(client: httpx.Client) -> None:
    """Wait until sessions can be opened; kernels are compiled once, at the first start on a machine."""
    if _says_ready(client) is None:
        return
    begun_s = time.monotonic()
    with waiting_for(SAID) as say:
        while (said := _says_ready(client)) is not None:
            say(said)
            if time.monotonic() - begun_s > _COMPILING_S:
                fail("the service did not become ready in ten minutes: run it again, what was compiled is kept")
            time.sleep(_POLL_S)


def _says_ready(client: httpx.Client) -> str | None:
    """What it is still at; None when it can scan. One that is too busy compiling to answer cannot yet."""
    try:
        told = client.get("/readyz", timeout=_ANSWER_S).json()
    except httpx.TimeoutException:
        return SAID
    if told["checks"]["kernels"]:  # a record that takes no lines is another matter: what is asked for says so
        return None
    now = told["preparing"]
    if now is None:
        return SAID
    verb, when = ("compiling", " (only the first time)") if now["compiles"] else ("loading", "")
    return f"{verb} {now['what']}, step {now['step']} of {now['of']}{when} …"
