"""The mistakes and failures that a user can meet, each with the exit code it ends a command with.

A programming mistake is not one of these: it stays a traceback (exit code 1).
"""

import sqlite3

# What SQLite raises of a damaged file: its words quote names of the file, which need not be UTF-8.
DATABASE_ERRORS = (sqlite3.Error, UnicodeDecodeError)


# Of a message: a name out of a damaged table, which it quotes, may have any length.
MAX_LETTERS = 2000


class OptnavError(Exception):
    """Base of all reported failures; the message says where, what was found, wanted and to do."""

    exit_code = 1

    def __init__(self, message: str) -> None:
        super().__init__(limit_length(message))


def limit_length(message: str) -> str:
    """A message whose middle is left out if it is longer than any person reads."""
    if len(message) <= MAX_LETTERS:
        return message
    return f"{message[: MAX_LETTERS // 2]} [...] {message[-MAX_LETTERS // 2 :]}"


class UsageError(OptnavError):
    """The command was called with words it does not take."""

    exit_code = 2


class ConfigError(OptnavError):
    """A configuration file is wrong."""

    exit_code = 3


class DataError(OptnavError):
    """An input file is missing, damaged or not what it claims to be."""

    exit_code = 3


class OutputError(OptnavError):
    """A place to write to cannot be used."""

    exit_code = 3


class WorkersError(OptnavError):
    """The processes or machines that were to do the work cannot."""

    exit_code = 3


class NothingToDoError(OptnavError):
    """The command ran but nothing could be solved or selected."""

    exit_code = 4


class NoSolutionError(OptnavError):
    """One frame or one fit has no solution; the message is the reason, `code` its machine code."""

    exit_code = 4

    def __init__(self, reason: str, code: str = "no_solution") -> None:
        super().__init__(reason)
        self.code = code


class DifferenceError(OptnavError):
    """A comparison differs or a limit is passed."""

    exit_code = 5
