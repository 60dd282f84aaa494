"""Scanners that exist only in software, and speak the device's half of the wire."""
