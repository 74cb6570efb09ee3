"""The errors that a user can cause or meet; the program prints their text alone."""


class InputError(ValueError):
    """Something that the user gave cannot be used.

    The text is one sentence: which file or option, what was found, what is allowed.
    """


class RunError(RuntimeError):
    """A run had to stop: a diverged state, a full neighbour list, a full disk."""
