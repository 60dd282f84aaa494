"""Replies of a lidar that speaks SCIP 2.0, written by hand: each sum was added up apart.

The sum of "99" is 39h + 39h = 72h; its low six bits are 32h, and 30h + 32h = 62h is the letter b.
"""

VERSION = b"VV\n00P\nVEND:Acme;M\nPROD:Lidar 9;d\nFIRM:1.0;g\nPROT:SCIP 2.0;N\nSERI:X7;l\n\n"
VERSION_FIELDS = {"VEND": "Acme", "PROD": "Lidar 9", "FIRM": "1.0", "PROT": "SCIP 2.0", "SERI": "X7"}
PARAMETERS = (
    b"PP\n00P\nMODL:Acme 9;e\nDMIN:20;4\nDMAX:4000;X\nARES:360;n\nAMIN:0;?\nAMAX:180;j\nAFRT:90;@\nSCAN:600;e\n\n"
)
STOPPED = b"QT\n00P\n\n"
LASER_IS_OFF = b"GD0000003901\n10Q\n\n"
NO_SUCH_COMMAND = b"ZZ\n0Ee\n\n"
RATE_IS_SET = b"SS019200\n03S\n\n"

SCAN_MILLISECONDS = 0x123456
SCAN_DISTANCES_MM = [100 + 7 * k for k in range(40)]
SCAN = (
    b"MS0000003901005\n99b\n4SAF>\n"
    b"1T1[1b1i20272>2E2L2S2Z2a2h2o363=3D3K3R3Y3`3g3n454<4C4J4Q4X4_4f4mW\n"
    b"545;5B5I5P5W5^5e<\n\n"
)
