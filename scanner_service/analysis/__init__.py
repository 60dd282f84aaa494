"""The live map and its oracle: pure numpy, scipy and numba; no port, no clock, no thread."""
