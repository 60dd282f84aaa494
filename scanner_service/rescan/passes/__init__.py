"""Recommended passes: what a rig can do, what it would see, what that gains; pure."""
