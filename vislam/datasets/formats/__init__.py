"""One module per format of recordings."""
