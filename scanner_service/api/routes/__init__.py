"""One small router a subject; each translates a request into one call, and its result into one answer."""
