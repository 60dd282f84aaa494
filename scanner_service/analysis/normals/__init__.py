"""Normals of clouds without scanlines by every method of the chapter: one signature, one result; knows no laser."""
