"""Errors that users can mend."""


class InputError(ValueError):
    """Something that the user gave cannot be used; the message says what, and what to do."""
