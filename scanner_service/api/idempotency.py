"""The Idempotency-Key of a request that creates: what was asked under which key; makes and stores nothing itself.

A client that got no answer sends the request again with the same key, and gets what the first one made. The keys are
kept in the record, as hashes, with the session: they outlast the service.
"""

import hashlib
import json
from typing import Annotated

from fastapi import Header
from pydantic import BaseModel

from scanner_service.api.access import Identity
from scanner_service.storage.rows import CreationKey

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=255,
        pattern=r"^[\x21-\x7e]+$",
        description="A text of your own, new for each session: the same request with the same key makes no second one.",
    ),
]


def creation_key(key: str | None, who: Identity, body: BaseModel) -> CreationKey | None:
    """The key of a request by somebody, None without one; two people may use the same text."""
    if key is None:
        return None
    asked = json.dumps(body.model_dump(mode="json"), sort_keys=True).encode()
    return CreationKey(
        hashlib.sha256(f"{who.label}\0{key}".encode()).hexdigest(),
        hashlib.sha256(asked).hexdigest(),
    )
