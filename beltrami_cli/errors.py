"""Exceptions whose message is the one line a user reads, each with the exit code that tells causes apart."""


class BeltramiError(Exception):
    """Base of every error that is reported as a single line; never raised itself."""

    exit_code = 1


class DataError(BeltramiError):
    """The content of an input cannot be used: unreadable, truncated, no zero level, nothing but NaN."""


class NumericsError(BeltramiError):
    """A computation left the finite numbers."""


class RefusedError(BeltramiError):
    """Refused before starting: usage, configuration, an output that exists, grids that differ, dt over its bound."""

    exit_code = 2


class BusyError(RefusedError):
    """Refused because another run is writing the same outputs at this moment: it can be tried again later."""


def in_a_line(error: BaseException) -> str:
    """What any error says, without line breaks; empty where it says nothing."""
    return " ".join(str(error).split())
