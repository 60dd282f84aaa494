"""What a scan session refuses, as facts.

SessionError
├── SessionNotLive      the session is in the record, but not open
├── SessionBusy         the request does not fit the session's state
├── PassUnknown         no such recommended or accepted pass
├── PartNotTurned       the pass asks for a turn of the part, and nobody said that it is turned
├── PlanOvertaken       the plan in which a pass was seen is not in force any more
├── KernelsCompiling    no session can be opened before the kernels are compiled
├── BudgetSpent         the disk budget is used up, and no session may be deleted to make room
├── SourceUnusable      what the session should read from cannot be read
├── FileUnknown         no file of that name lies in the replay folder
├── NameTaken           another file has that name
├── LineRefused         one scanline was not taken in, for the reason told
├── AnalysisUnknown     there is no analysis of that id, or its room was needed
├── AnalysisNotDone     the analysis has no result: it waits, runs or has failed
└── AnalysesBusy        as many analyses as may wait are waiting
"""


class SessionError(Exception):
    """Root of everything a session refuses."""


class SessionNotLive(SessionError):
    """The session is known, but nothing holds it open."""


class SessionBusy(SessionError):
    """The request does not fit the state that the session is in."""


class PassUnknown(SessionError):
    """There is no recommended or accepted pass of that number."""


class PartNotTurned(SessionError):
    """The pass asks for a turn of the part, and nobody said that it is turned; its order waits on."""


class PlanOvertaken(SessionError):
    """The plan in which a pass was seen is not in force any more."""


class KernelsCompiling(SessionError):
    """No session can be opened before the kernels are compiled; the message says how far that is."""


class BudgetSpent(SessionError):
    """The disk budget is used up, and no session may be deleted to make room."""


class SourceUnusable(SessionError):
    """What the session should read from cannot be read."""


class FileUnknown(SessionError):
    """No file of that name lies in the replay folder."""


class NameTaken(SessionError):
    """Another file has that name."""


class LineRefused(SessionError):
    """One scanline was not taken in; `reason` is the name under which the ledger counts it."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class AnalysisUnknown(SessionError):
    """There is no analysis of that id, or its room was needed."""


class AnalysisNotDone(SessionError):
    """The analysis has no result: it waits, runs or has failed."""


class AnalysesBusy(SessionError):
    """As many analyses as may wait are waiting."""
