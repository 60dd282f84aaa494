"""Live quality for laser-line scanning: what was measured, how well, and what to scan again."""

from importlib.metadata import version

__version__ = version("scanner-service")
