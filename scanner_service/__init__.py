"""Live quality for laser-line scanning: what was measured, how well, and what to scan again."""
