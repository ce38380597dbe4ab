"""A live run in a browser: a process of its own that listens on this machine, and what it serves."""
