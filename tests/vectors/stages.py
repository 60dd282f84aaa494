"""Bytes of stage controllers, written by hand from the manufacturers' documents, and what they must mean."""

from drivers.protocols import grbl, marlin, zaber
from drivers.protocols.tmcl import Telegram

GRBL: dict[str, tuple[bytes, list[grbl.Said]]] = {
    "banner": (b"\r\nGrbl 1.1h ['$' for help]\r\n", [grbl.Banner("Grbl", "1.1h")]),
    "ok": (b"ok\r\n", [grbl.Ok()]),
    "refusal": (b"error:20\r\n", [grbl.Refusal(20)]),
    "alarm": (b"ALARM:1\r\n", [grbl.Alarm(1)]),
    "report with work position first": (
        b"<Hold:1|WPos:-1.500,0.000,2.000|Bf:15,128|Ln:99|F:500|WCO:1.000,0.000,-2.000|A:SFM>\r\n",
        [grbl.Report(grbl.State.HOLD, 1, (), (-1.5, 0.0, 2.0), (1.0, 0.0, -2.0), 500.0, "", 128)],
    ),
    "report without fields": (b"<Sleep>\r\n", [grbl.Report(grbl.State.SLEEP)]),
    "settings": (
        b"$13=0\r\n$130=200.000\r\nok\r\n",
        [grbl.Setting(13, 0.0), grbl.Setting(130, 200.0), grbl.Ok()],
    ),
    "startup line": (b">G54:ok\r\n", [grbl.Other(">G54:ok")]),
    "feedback": (b"[MSG:'$H'|'$X' to unlock]\r\n", [grbl.Feedback("MSG:'$H'|'$X' to unlock")]),
    "report with a damaged number": (
        b"<Idle|MPos:0.0.0,0.000,0.000|FS:0,0>\r\n",
        [grbl.Other("<Idle|MPos:0.0.0,0.000,0.000|FS:0,0>")],
    ),
    "report with two reports run into one": (
        b"<Idle|MPos:0.000,0.000<Idle|MPos:0.000,0.000,0.000|FS:0,0>\r\n",
        [grbl.Other("<Idle|MPos:0.000,0.000<Idle|MPos:0.000,0.000,0.000|FS:0,0>")],
    ),
}

MARLIN: dict[str, tuple[bytes, list[marlin.Said]]] = {
    "start": (b"start\n", [marlin.Started()]),
    "ok with more": (b"ok P15 B3\n", [marlin.Done("P15 B3")]),
    "busy": (b"echo:busy: processing\n", [marlin.Busy("processing")]),
    "checksum": (
        b"Error:checksum mismatch, Last Line: 4\nResend: 5\nok\n",
        [marlin.Trouble("checksum mismatch, Last Line: 4", False), marlin.Resend(5), marlin.Done()],
    ),
    "halt": (
        b"Error:Printer halted. kill() called!\n",
        [marlin.Trouble("Printer halted. kill() called!", True)],
    ),
    "position": (
        b"X:10.00 Y:-2.50 Z:0.00 E:0.00 Count X:800 Y:-200 Z:0\n",
        [
            marlin.Position(
                {"X": 10.0, "Y": -2.5, "Z": 0.0, "E": 0.0},
                {"X": 800, "Y": -200, "Z": 0},
            )
        ],
    ),
    "steps": (
        b"echo:  M92 X80.00 Y80.00 Z400.00 E93.00\n",
        [marlin.Steps({"X": 80.0, "Y": 80.0, "Z": 400.0, "E": 93.0})],
    ),
    "capability": (b"Cap:EMERGENCY_PARSER:1\n", [marlin.Capability("EMERGENCY_PARSER", True)]),
    "damaged position": (b"X:10.00 Y:-2.50 Z:0.0", []),
    "remark": (b"// action:pause\n", [marlin.Remark("// action:pause")]),
}

ZABER: dict[str, tuple[bytes, list[zaber.Said]]] = {
    "reply without id and sum": (b"@01 0 OK IDLE -- 0\r\n", [zaber.Reply(1, 0, -1, True, False, "--", "0")]),
    # The characters "01 1 07 OK BUSY WR 1234" add up to 0x509; the two's complement of 09 is F7.
    "reply with id and sum": (
        b"@01 1 07 OK BUSY WR 1234:F7\r\n",
        [zaber.Reply(1, 1, 7, True, True, "WR", "1234")],
    ),
    "reply with a wrong sum": (b"@01 1 07 OK BUSY WR 1234:F8\r\n", [zaber.Damaged("@01 1 07 OK BUSY WR 1234:F8")]),
    "refusal": (b"@01 1 RJ IDLE -- BADDATA\r\n", [zaber.Reply(1, 1, -1, False, False, "--", "BADDATA")]),
    "alert": (b"!01 1 IDLE --\r\n", [zaber.Alert(1, 1, False, "--")]),
    "info": (b"#01 0 Visit zaber.com\r\n", [zaber.Info(1, "Visit zaber.com")]),
}

ZABER_COMMANDS = {
    # "1 0 00 get pos": 31+20+30+20+30+30+20+67+65+74+20+70+6F+73 = 0x3D3, two's complement of the low byte 2D
    b"/1 0 00 get pos:2D\n": (1, 0, "get pos", 0),
}

GRBL_JOG = (b"$J=G53G90G21X-12.5000F600.00\n", ("X", -12.5, 600.0))
MARLIN_LINES = {
    # N1 G1 X10 F600: the exclusive or of its characters is 0
    b"N1 G1 X10 F600*0\n": (1, "G1 X10 F600"),
    b"N-1 M110 N-1*125\n": (-1, "M110 N-1"),
}

TMCL: dict[str, tuple[bytes, Telegram]] = {
    "ROR 0, 1000": (bytes.fromhex("01 01 00 00 00 00 03 E8 ED"), Telegram(1, 1, 0, 0, 1000)),
    "GAP 1": (bytes.fromhex("01 06 01 00 00 00 00 00 08"), Telegram(1, 6, 1, 0, 0)),
    "reply with a negative value": (bytes.fromhex("02 01 64 06 FF FF FF FE 68"), Telegram(2, 1, 100, 6, -2)),
}
