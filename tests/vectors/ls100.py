"""Frames of a Profiler 2 or LS-100, put together by hand: a sensor whose profile of three points lies at 12345678h."""

ASK_ADDRESS = bytes.fromhex("02 00 40 0b 03 4b")
ADDRESS_REPLY = bytes.fromhex("02 02 40 0b 12 34 56 78 03 41")
ASK_SIZE = bytes.fromhex("02 03 00 02 12 34 56 78 01 11 03 19")
SIZE_REPLY = bytes.fromhex("02 03 00 02 12 34 56 78 00 60 03 69")
"""60h / 32 = 3 points."""
SIZE_REPLY_WITH_TIME = bytes.fromhex("02 04 00 02 12 34 56 78 00 60 01 02 03 6d")
"""The other reading: 0102h = 258 tenths of a millisecond."""
ASK_POINTS = bytes.fromhex("02 03 00 02 12 34 56 7c 03 21 03 2f")
POINTS_REPLY = bytes.fromhex("02 08 00 02 12 34 56 7c ff 9c 03 e8 7f ff 7f ff 00 64 fc 18 03 0e")
"""-0.1 mm, 1 mm; nothing; 0.1 mm, -1 mm."""
CHECK_ERROR = bytes.fromhex("02 00 e0 04 03 e4")
