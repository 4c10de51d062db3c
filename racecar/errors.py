"""The one exception for input that a person or program got wrong."""


class BadInput(Exception):
    """Input that cannot be used.

    The message is one line: what is wrong, where, and what to do. Every command
    prints it and ends with exit status 2.
    """
