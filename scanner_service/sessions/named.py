"""Which session a person means by the first letters of its id; knows ids alone."""

from collections.abc import Iterable

from scanner_service.sessions.errors import SourceUnusable


def named_session(newest_first: Iterable[str], wanted: str) -> str:
    """Which of the ids is meant: that id, the only one that begins so, or the newest for `latest`.

    Raises
    ------
    SourceUnusable : none, or several; the sentence says which there are.
    """
    begun, seen = [], 0
    for session_id in newest_first:
        if wanted in ("latest", session_id):
            return session_id
        seen += 1
        begun += [session_id] if session_id.lower().startswith(wanted.lower()) else []
    if len(begun) == 1:
        return begun[0]
    if begun:
        raise SourceUnusable(f"{len(begun)} sessions begin with {wanted}: {', '.join(begun[:5])}; give more letters")
    raise SourceUnusable(
        f"the record holds no session {wanted}; it holds {seen}, of which `latest` is the newest"
        if seen
        else "the record holds no session"
    )
