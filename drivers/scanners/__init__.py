"""One small file a scanner: protocol and port, and the verbs enter, stream, exit; `known.py` has them by name."""
