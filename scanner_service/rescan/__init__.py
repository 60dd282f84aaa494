"""What to scan again and why: pure functions of a map snapshot."""
