"""Every exception that scanweld raises on purpose.

    ScanweldError
    ├── InvalidInputError (also a ValueError)   an argument or array breaks the contract
    ├── ConfigError       (also a ValueError)   a configuration key or value is wrong
    ├── FileFormatError                         a file cannot be read as what it claims to be
    ├── DatasetError                            a sequence folder is missing, empty or inconsistent
    │   └── UnreadableFrameError                one frame cannot be decoded; the run goes on without it
    ├── OutputError                             an output cannot be written, or would overwrite something
    └── MissingDependencyError (also an ImportError)   an optional extra is not installed

A message says what, what was got, what was expected, and what to do, in one line of printable characters whatever the
file at fault holds. Data that allows no answer is no
exception: see :class:`scanweld.registration.result.Status`.
"""

from __future__ import annotations

__all__ = [
    "ConfigError",
    "DatasetError",
    "FileFormatError",
    "InvalidInputError",
    "MissingDependencyError",
    "OutputError",
    "ScanweldError",
    "UnreadableFrameError",
]


LONGEST_MESSAGE = 2000
"""What is longer repeats what a file holds."""


class ScanweldError(Exception):
    """Base of every error raised on purpose; the command line prints it in one line and exits with 1."""

    def __str__(self) -> str:
        text = super().__str__()
        text = text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]}.."
        # A file may hold line ends, and codes that a terminal obeys.
        return text if text.isprintable() else "".join(c if c.isprintable() else "\ufffd" for c in text)


class InvalidInputError(ScanweldError, ValueError):
    """An argument has the wrong shape, dtype, range or content."""


class ConfigError(ScanweldError, ValueError):
    """A configuration key is unknown or its value out of range."""


class FileFormatError(ScanweldError):
    """A file is missing, truncated, or not of the format it claims to be."""


class DatasetError(ScanweldError):
    """A sequence cannot be used: missing, empty, inconsistent or of an unknown format.

    Attributes
    ----------
    fault : what `scanweld check` calls that, where it has a name for it
    """

    def __init__(self, message: str = "", *, fault: str = "") -> None:
        super().__init__(message)
        self.fault = fault


class UnreadableFrameError(DatasetError):
    """One frame of a sequence cannot be decoded."""


class OutputError(ScanweldError):
    """An output cannot be written, or writing it would overwrite something."""


class MissingDependencyError(ScanweldError, ImportError):
    """An optional dependency is needed and not installed."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"this needs {package}, which is not installed: pip install 'scanweld[{extra}]'")
