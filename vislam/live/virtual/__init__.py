"""A virtual cart: exact motion in a rendered workshop, the real drivers over emulated chips, a camera of its own."""
