"""Telegrams of an LMS2xx, put together by hand; the checks were divided out on lists of sixteen bits.

`crc_on_bits` is that division: shift left, take 8005h off where a one falls out, add the byte and the one before.
"""


def crc_on_bits(data: bytes) -> int:
    """The check of a telegram, from its definition."""
    bits, before = [0] * 16, 0
    for byte in data:
        fell_out, bits = bits[0], [*bits[1:], 0]
        for place in (0, 13, 15) if fell_out else ():
            bits[place] ^= 1
        added = before << 8 | byte
        bits = [bit ^ added >> 15 - place & 1 for place, bit in enumerate(bits)]
        before = byte
    return int("".join(map(str, bits)), 2)


STREAM_REQUEST_TO_5 = bytes.fromhex("02 05 02 00 20 24  64 20")
VARIANT_REQUEST = bytes.fromhex("02 00 05 00 3b 64 00 19 00  e7 72")
"""100 degrees in steps of 0.25."""

MODE_REPLY = bytes.fromhex("02 85 03 00 a0 00 10  b6 5a")
TYPE_REPLY = bytes.fromhex("02 85 0f 00 ba 4c 4d 53 32 39 31 3b 37 3b 56 31 2e 30 11  90 2b")
VALUES = bytes.fromhex("02 85 0e 00 b0 04 40 e8 03 e9 43 ff 1f f7 1f c8 11 10  7b 3b")
"""Four values in mm: 1000; 1001 with a flag (4000h); 1FFFh nothing came back; 1FF7h too far. Indices 200 and 17."""
PARTIAL_VALUES = bytes.fromhex("02 80 08 00 b0 02 28 64 00 c8 00 10  17 ae")
"""Two values in cm, 1 m and 2 m, of the scan that is moved by 0.25 degree; no indices."""
