"""The simulated worlds by name, and a world as a recording."""
