"""One small file a scanner: its protocol on a port, and the verbs enter, stream, exit."""
