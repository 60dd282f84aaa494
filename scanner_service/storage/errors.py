"""What can go wrong with the durable record, as facts; knows no cause's cure beyond one sentence.

RecordError
├── RecordUnusable            the record could not be opened
│   ├── NotARecord            the file is something else
│   ├── RecordTooNew          written by a newer version of the service
│   ├── RecordInUse           another service holds it
│   ├── RecordNotWritable     no such folder, a folder itself, read-only, not permitted
│   ├── SqliteTooOld
│   └── RecordNotDurable      the database server may forget what it has confirmed, or cannot be reached
├── RecordBusy                the spool is full: the line was not taken
├── RecordClosed              nothing is taken after close; what waited is not confirmed
├── SessionUnknown            no such session, or it is deleted
├── SessionDamaged            the session's row fails its checksum and may not be changed
├── CreationKeyReused         the key of a request to create came before with another request
├── NotStorable               the value does not fit the record
├── WriteRefused              the database refused this one value; the others went on
├── RecordUnreadable          the database could not answer
└── LineDamaged               stored bytes that fail their checksum, or are gone
"""


class RecordError(Exception):
    """Base of everything the record raises."""


class RecordUnusable(RecordError):
    """The record could not be opened; nothing was changed."""


class NotARecord(RecordUnusable):
    """The file exists and is not a record of this service."""


class RecordTooNew(RecordUnusable):
    """The record was written by a newer version of the service."""


class RecordInUse(RecordUnusable):
    """Another service has the record open."""


class RecordNotWritable(RecordUnusable):
    """The place of the record cannot be written to."""


class SqliteTooOld(RecordUnusable):
    """The SQLite library of this Python is older than the record needs."""


class RecordNotDurable(RecordUnusable):
    """The database server is set up so that it may forget what it has confirmed, or cannot be reached at all."""


class RecordBusy(RecordError):
    """The spool is full; what was offered was not taken and must be counted or offered again by the caller."""


class RecordClosed(RecordError):
    """The record is closed; what was offered or still waiting is not confirmed as stored."""


class SessionUnknown(RecordError):
    """There is no such session in the record."""


class SessionDamaged(RecordError):
    """The session's own row fails its checksum."""


class CreationKeyReused(RecordError):
    """The key of a request to create came before, with another request."""


class NotStorable(RecordError, ValueError):
    """A value that the record cannot keep exactly."""


class WriteRefused(RecordError):
    """The database refused one value for what it is."""


class RecordUnreadable(RecordError):
    """The database could not answer; what of the record can still be read depends on where it is damaged."""


class LineDamaged(RecordError):
    """A stored line fails its checksum, cannot be decoded, or is gone."""
