"""The processes of a live run."""
