"""Bytes of an RPLIDAR, put together by hand from the layouts in docs/devices/rplidar.md.

The capsule starts at 5 degrees (140h in 1/64 degree, top bit: the stream has just begun). Its samples measure 1000,
2000, 1001, 2001 ... mm with angle offsets 05h and 21h by turns, so the two top bits of the second, 2, go into its
distance's word (2000 * 4 + 2 = 1F42h) and the low halves share a byte (15h). Its check, C1h, stands in
the low halves of its first two bytes, the lower half first.
"""

INFO_REQUEST = bytes.fromhex("a5 50")
EXPRESS_REQUEST = bytes.fromhex("a5 82 05 00 00 00 00 00 22")
PWM_REQUEST = bytes.fromhex("a5 f0 02 94 02 c1")

INFO = bytes.fromhex("a5 5a 14 00 00 00 04  18 1d 01 07  00 11 22 33 44 55 66 77 88 99 aa bb cc dd ee ff")
HEALTH = bytes.fromhex("a5 5a 03 00 00 00 06  01 34 12")
SAMPLERATE = bytes.fromhex("a5 5a 04 00 00 00 15  fc 01 fe 00")
CONF_TYPICAL_MODE_IS_1 = bytes.fromhex("a5 5a 06 00 00 00 20  7c 00 00 00 01 00")

STANDARD_DESCRIPTOR = bytes.fromhex("a5 5a 05 00 00 40 81")
SAMPLE = bytes.fromhex("3d 41 2d 49 13")
"""Starts a turn, quality 15, at 90.5 degrees, 1234.25 mm: 90.5 * 64 = 16A0h, doubled plus one 2D41h; 4937 = 1349h."""
SAMPLE_NOTHING = bytes.fromhex("02 41 2d 00 00")
"""No start of a turn, nothing came back."""

EXPRESS_DESCRIPTOR = bytes.fromhex("a5 5a 54 00 00 40 82")
CAPSULE = bytes.fromhex(
    "a1 5c 40 81 a0 0f 42 1f 15 a4 0f 46 1f 15 a8 0f 4a 1f 15 ac 0f 4e 1f 15 b0 0f 52 1f 15 b4 0f 56 1f 15 b8 0f 5a 1f"
    "15 bc 0f 5e 1f 15 c0 0f 62 1f 15 c4 0f 66 1f 15 c8 0f 6a 1f 15 cc 0f 6e 1f 15 d0 0f 72 1f 15 d4 0f 76 1f 15 d8 0f"
    "7a 1f 15 dc 0f 7e 1f 15"
)

ULTRA_DESCRIPTOR = bytes.fromhex("a5 5a 84 00 00 40 84")
ULTRA = bytes.fromhex("a2 52 40 81 90 32 40 01") + bytes(124)
"""Starts at 5 degrees; its first cabin is 290h (800 mm) and the steps 3 and 5: 290h + 3000h + 1400000h. Check 22h."""
