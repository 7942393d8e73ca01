"""The one exception a user's mistake raises."""


class UserError(ValueError):
    """A mistake that the person at the keyboard can mend; its message is one line saying how.

    Commands print the message and exit with 1; anything else is a bug and keeps its traceback.
    """
