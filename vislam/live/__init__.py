"""The stages of a run in processes of their own, driven by live sensors."""
