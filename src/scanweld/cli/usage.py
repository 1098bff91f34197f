"""Help and usage errors in the words of a person who types commands."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib import import_module
from typing import Any

import typer

from scanweld.errors import ScanweldError

WORDS = {
    "int_parsing": "expected a whole number",
    "float_parsing": "expected a number",
    "greater_than_equal": "expected {ge:g} or more",
    "greater_than": "expected more than {gt:g}",
    "less_than_equal": "expected {le:g} or less",
    "less_than": "expected less than {lt:g}",
}
"""What the kinds of errors of Pydantic mean, by which Typer checks values."""


def help_of(command: Callable[..., Any]) -> str:
    """Return the docstring of a command, a line for each paragraph: a terminal breaks lines where it ends."""
    paragraphs = inspect.cleandoc(command.__doc__ or "").split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def well_formed(module: str, parser: str) -> Callable[..., Any]:
    """Return a callback of an option that makes text which its parser refuses wrong usage.

    The parser is loaded when there is text to parse; what it returns is left to the command.
    """

    def check(option: typer.CallbackParam, value: Any) -> Any:
        texts = [value] if isinstance(value, str) else value or []
        for text in texts:
            try:
                getattr(import_module(module), parser)(text)
            except ScanweldError as error:
                raise typer.BadParameter(str(error).removeprefix(f"{option.name}: ")) from None
        # Earlier versions of Typer ask how long the list is that was not given.
        return () if value is None and option.multiple else value

    return check


def in_plain_words(error: Exception) -> Exception:
    """Return a usage error of the parser with a message that tells what was expected and what was got."""
    faults = getattr(error.__cause__, "errors", None)
    if faults is not None and hasattr(error, "message"):
        fault = faults()[0]
        words = WORDS.get(fault["type"])
        if words is not None:
            error.message = f"{words.format(**fault.get('ctx', {}))}, got {str(fault['input'])!r}"
        else:
            error.message = fault["msg"].removeprefix("Value error, ")
    return error
