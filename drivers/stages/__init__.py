"""Drivers of stages: one small file a controller; every one has the face of `face.py` and is listed in `known.py`."""
