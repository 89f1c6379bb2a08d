"""The one exception that users see."""

from __future__ import annotations


class NeecoError(Exception):
    """Bad input. The message is one line naming the file, the field and what to do; the command line prints it and
    exits 1.

        try:
            neeco.load("runs/nothing")
        except neeco.NeecoError as error:
            print(error)
    """
