"""Recordings that cannot be annotated: left out with a reason that is counted."""


class LeftOut(Exception):
    """A recording that yields no annotated touch; the message is one of a few fixed reasons."""
