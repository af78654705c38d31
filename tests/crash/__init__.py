"""Commands that are ended in the middle, in every way that happens; see `__main__`."""
