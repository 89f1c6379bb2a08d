"""The one exception that users see."""

from __future__ import annotations


class NeecoError(Exception):
    """Bad input. The message is one line naming the file, the field and what to do; the command line prints it and
    exits 1. In Python an option named there is the argument of that name: `--max-attempts` is `max_attempts`.

        try:
            neeco.load("runs/nothing")
        except neeco.NeecoError as error:
            print(error)
    """
