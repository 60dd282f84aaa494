"""What each kind of problem means to whoever meets it: what happened, what to do, where to read on; no more."""

from typing import NamedTuple

API, SECURITY, RECORD, FILES = "docs/api.md", "docs/security.md", "docs/record.md", "docs/files.md"
PASSES, DEVICES, METHODS, REGIONS = "docs/passes.md", "docs/devices/index.md", "docs/methods.md", "docs/regions.md"
_WRONG, _BRING = f"{API}#when-something-is-wrong", f"{FILES}#bringing-a-file"
_WHO, _REACH, _TAKES = f"{SECURITY}#who-may-do-what", f"{SECURITY}#who-may-reach-it", f"{SECURITY}#what-it-takes"
_SOURCES, _SETTINGS, _ANALYSES = f"{API}#sources", f"{API}#settings", f"{API}#analyses"
_DISK, _DRIVE, _WRITTEN = f"{RECORD}#when-the-disk-fails", f"{PASSES}#carrying-out", f"{FILES}#what-is-written"
_TROUBLES = f"{DEVICES}#fifteen-troubles-that-users-of-such-drivers-report-and-what-happens-here"


class Explanation(NamedTuple):
    """Three lines; `read` is a page of the documents that come with the program."""

    happened: str
    remedy: str
    read: str


EXPLANATIONS = {
    "malformed-json": Explanation(
        "The body of the request could not be read as JSON.", "Send one JSON value, in UTF-8.", _WRONG
    ),
    "invalid-request": Explanation(
        "The request has members that are missing, unknown, or of the wrong kind; `errors` names each place.",
        "Mend the places that `errors` names; `/docs` shows what each route takes.",
        _WRONG,
    ),
    "internal-error": Explanation(
        "The service met a fault of its own; nothing was confirmed.",
        "Look into the log of the service, and send it along when you report the fault; then try again.",
        _WRONG,
    ),
    "bad-host": Explanation(
        "The request names no host, or none that can be one.", "Use the address that `scanner serve` prints.", _REACH
    ),
    "foreign-host": Explanation(
        "The request was sent to a name that this service does not answer to.",
        "Use the address that it prints, or start it with `--allow-host NAME`.",
        _REACH,
    ),
    "foreign-origin": Explanation(
        "A page of another origin asked a browser to do this.",
        "Start the service with `--allow-origin ORIGIN` if that page is yours.",
        _REACH,
    ),
    "missing-origin": Explanation(
        "The request came with a cookie alone, and does not say from which page.",
        "Send a key in the header `Authorization: Bearer KEY`.",
        _WHO,
    ),
    "bad-path": Explanation(
        "The path has signs that no path of this service has.", "Look the path up in `/docs`.", _TAKES
    ),
    "body-too-large": Explanation(
        "The body is larger than this route takes.", "Send it in smaller parts; files go to `/api/v1/files`.", _TAKES
    ),
    "body-too-slow": Explanation(
        "The body came too slowly, and the service let go of the connection.",
        "Try again over a better connection; what is sent twice is stored once.",
        _TAKES,
    ),
    "media-type-refused": Explanation(
        "The body is of a kind that this route does not take.",
        "Send `Content-Type: application/json`, or the kind that `/docs` names for the route.",
        _TAKES,
    ),
    "json-encoding": Explanation("The body is not UTF-8.", "Encode the JSON as UTF-8.", _TAKES),
    "json-not-finite": Explanation(
        "The body holds NaN or an infinity, which JSON has no numbers for.",
        "Write `null` for what is not known.",
        _TAKES,
    ),
    "json-depth": Explanation(
        "The body nests deeper than anything that is asked for here.", "Send what `/docs` shows.", _TAKES
    ),
    "not-authenticated": Explanation(
        "The request does not say who sends it.",
        "Send `Authorization: Bearer KEY`; the service prints where its first key lies. A browser: `scanner open`.",
        _WHO,
    ),
    "key-mistyped": Explanation(
        "The key has a sign too few or wrong: its last signs do not fit the others.", "Copy the whole key again.", _WHO
    ),
    "key-unknown": Explanation(
        "The key is whole, and this service does not know it: of another one, or revoked.",
        "Use a key of this service, or make one with the role that is needed.",
        _WHO,
    ),
    "login-ended": Explanation("The browser's login has ended.", "`scanner open` gives a fresh address.", _WHO),
    "login-unknown": Explanation(
        "The one-time address was used already, or is older than ten minutes.",
        "`scanner open` gives a fresh one.",
        _WHO,
    ),
    "role-too-low": Explanation(
        "The key may look, or operate, but not do this.", "Use a key of the role that the message names.", _WHO
    ),
    "session-unknown": Explanation(
        "There is no session of that id; it may have been deleted, by hand or by the retention.",
        "`GET /api/v1/sessions` lists those there are.",
        _WRONG,
    ),
    "session-busy": Explanation(
        "The session, or what it needs, is busy with something else: the message says with what.",
        "Do what the message says first, or come again in a moment.",
        _WRONG,
    ),
    "session-not-live": Explanation(
        "The session is closed, or was closed meanwhile.", "Ask for it again: it is reopened from its lines.", _WRONG
    ),
    "kernels-compiling": Explanation(
        "The service was started a moment ago and still compiles what it computes with, once after an installation or "
        "an update; no session can be opened before.",
        "Send the request again after the seconds in `Retry-After`; `GET /readyz` says what is compiled and how far it "
        "is.",
        f"{API}#a-scan-from-the-shell",
    ),
    "budget-spent": Explanation(
        "Stored lines take all of the disk that the service was allowed, and no session may be deleted by itself.",
        "Delete sessions, or start the service with a larger `--disk-budget-gb`.",
        _DISK,
    ),
    "not-confirmed": Explanation(
        "A session would have been deleted for good, without a confirmation.",
        "Send the session's id once more, as `?confirm=ID`.",
        f"{API}#all-addresses",
    ),
    "idempotency-key-reused": Explanation(
        "The `Idempotency-Key` came before, with a request that asked for something else.",
        "Use a new key for each thing that is to be made.",
        f"{API}#requests-that-may-be-sent-again",
    ),
    "session-error": Explanation(
        "The session cannot do what was asked, as it is now.", "The message says what it lacks.", _WRONG
    ),
    "pass-unknown": Explanation(
        "There is no pass or order of that number.", "List the recommended passes, or the orders, again.", _DRIVE
    ),
    "part-not-turned": Explanation(
        "The rig reaches this pass only when the part is turned, and the request does not say that it is. Nothing "
        "moved, and the order waits on.",
        'Turn the part as the message says, then carry the same order out with `{"part_is_turned": true}`.',
        _DRIVE,
    ),
    "plan-overtaken": Explanation(
        "The plan was made for another map, requirement or rig, or for other regions: its numbers mean other passes.",
        "Ask for the plan again, and choose from that one.",
        _DRIVE,
    ),
    "pass-out-of-reach": Explanation(
        "The pass would drive the stage beyond its limits.", "Give another start and end, or mend the rig file.", _DRIVE
    ),
    "planning-impossible": Explanation(
        "No pass can be planned: the message says what is not known, or what stands against it.",
        "Describe the rig with `PUT …/rig`, or scan something first.",
        _DRIVE,
    ),
    "source-unusable": Explanation(
        "The source of scanlines cannot be opened as it was described.", "Mend what the message names.", _SOURCES
    ),
    "file-unknown": Explanation(
        "There is no file of that name in the service's folder.", "Bring it with `PUT /api/v1/files/NAME`.", _BRING
    ),
    "name-taken": Explanation(
        "Another file has that name, and none is replaced.", "Bring it by another name, or delete the other.", _BRING
    ),
    "file-unusable": Explanation(
        "The file cannot be read: the message says where it is not what it says it is.",
        "Write it again, or convert it to one of the formats that are read.",
        f"{FILES}#what-is-read",
    ),
    "line-refused": Explanation(
        "A scanline was not taken, and is counted by its reason.",
        "Send it again when the reason is gone; lines that are stored already stay stored once.",
        f"{API}#pushing-scanlines",
    ),
    "port-absent": Explanation(
        "There is no serial port of that name.", "Plug the device in; `scanner devices` lists the ports.", _TROUBLES
    ),
    "port-busy": Explanation(
        "The port is held by a session, or by another program.", "Stop the one that the message names.", _TROUBLES
    ),
    "port-not-permitted": Explanation(
        "The user that runs the service may not open the port.",
        "Add that user to the group of the port; `scanner doctor` says which.",
        _TROUBLES,
    ),
    "pass-refused": Explanation(
        "The scanner cannot drive this pass: it is too fine, too fast or too far for it.",
        "Ask for what the message says that it can.",
        _DRIVE,
    ),
    "scanner-error": Explanation(
        "The scanner or the stage does not do its part: silent, gone, or in a fault of its own.",
        "Look at cable and power; `scanner doctor RIG` asks both and says what is wrong.",
        _TROUBLES,
    ),
    "too-many-passes": Explanation(
        "More passes than can be kept apart came into one session.", "Go on in another session.", f"{API}#the-ledger"
    ),
    "record-slow": Explanation(
        "The disk did not answer in time; what was asked for may be done yet.",
        "Look whether it was done before you ask again; look at the disk.",
        _DISK,
    ),
    "analysis-unknown": Explanation(
        "There is no analysis of that number; they are kept in memory, the latest only.", "Start it again.", _ANALYSES
    ),
    "analysis-not-done": Explanation(
        "The analysis is still at work, or came to no result: its state says which.",
        "Ask for its state until it is done.",
        _ANALYSES,
    ),
    "analyses-busy": Explanation(
        "As many analyses wait as may.", "Come again when one of them is done.", _ANALYSES
    ),
    "method-unknown": Explanation(
        "There is no method of that name.", "Choose one of those that the message lists.", METHODS
    ),
    "method-refused": Explanation(
        "The method cannot be used on these points, or with these values.", "Mend what the message names.", METHODS
    ),
    "map-full": Explanation(
        "The session has as many points as it was made for.",
        "Go on in another session, made with a larger `max_points`.",
        _SETTINGS,
    ),
    "record-busy": Explanation(
        "The disk is behind, and as much waits in memory as may: nothing of the request was taken.",
        "Send it again in a moment; free space if the disk is full.",
        _DISK,
    ),
    "record-error": Explanation(
        "The record could not be read or written; the log has the details.",
        "`scanner verify` looks at exports; a damaged session is told, and keeps no other from being served.",
        f"{RECORD}#opening",
    ),
    "reference-unusable": Explanation(
        "The mesh is no part that a scan could be measured against.",
        "Bring a closed mesh in the unit that you name, lying where the scan is.",
        _SETTINGS,
    ),
    "requirement-unusable": Explanation(
        "What is asked for contradicts itself, or is finer than the scanner's own noise; `fields` names it.",
        "Ask for less, or state the scanner's noise.",
        f"{REGIONS}#what-is-asked-for",
    ),
    "invalid-value": Explanation(
        "A value has the right kind and cannot be used.", "Mend the value that the message names.", _WRONG
    ),
    "export-unknown": Explanation(
        "There is no such export, or it was taken back.", "List the exports of the session, or order it.", _WRITTEN
    ),
    "format-unknown": Explanation(
        "No file of that format is written.", "Choose one of those that the message lists.", _WRITTEN
    ),
    "format-not-installed": Explanation(
        "The format needs a library that this computer does not have.",
        "Install it as the message says, and start the service again.",
        _WRITTEN,
    ),
    "export-failed": Explanation(
        "The file could not be written whole, and is not there.", "Free space on the disk, order it again.", _WRITTEN
    ),
}  # fmt: skip
"""By the slug of the problem's type."""


def explanation_of(slug: str, status: int) -> Explanation:
    """Of a kind of problem; of a bare HTTP status what can be said of all of them."""
    if slug in EXPLANATIONS:
        return EXPLANATIONS[slug]
    blame = "The request" if status < 500 else "The service"
    return Explanation(
        f"{blame} met the HTTP status {status}, of which the answer's `detail` says more.",
        "Look the route up in `/docs`." if status < 500 else "Try again in a moment; look into the log of the service.",
        _WRONG,
    )
