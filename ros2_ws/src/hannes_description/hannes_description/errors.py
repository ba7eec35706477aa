"""The one error type that a user's mistake raises."""


class HannesError(ValueError):
    """A mistake in the input (file, value, name, data); the message says what, where and what to do.

    Command line and nodes print the message without a traceback and exit with code 2.
    """
