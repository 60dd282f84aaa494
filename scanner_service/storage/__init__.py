"""The durable record of sessions, and the files that go in and out."""
