"""Scanners and stages on serial lines; stands alone and knows nothing of the service."""
