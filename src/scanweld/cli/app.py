"""The command table, and how an error becomes one line and an exit code.

Exit codes: 0 done; 1 a known error, one line; 2 usage; 3 done, but without a trustworthy answer; 130 Ctrl-C.
"""

from __future__ import annotations

import functools
import logging
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer

from scanweld.cli.batch import batch
from scanweld.cli.bench import bench
from scanweld.cli.check import check
from scanweld.cli.completion import completion
from scanweld.cli.config import config
from scanweld.cli.datasets import datasets
from scanweld.cli.demo import demo
from scanweld.cli.evaluate import evaluate
from scanweld.cli.examples import examples_of
from scanweld.cli.mesh import mesh
from scanweld.cli.register import register
from scanweld.cli.render import render
from scanweld.cli.repeat import repeat
from scanweld.cli.report import report
from scanweld.cli.slam import slam
from scanweld.cli.usage import help_of, in_plain_words
from scanweld.cli.view import view
from scanweld.cli.warmup import warmup
from scanweld.errors import ScanweldError

PANEL_COLUMNS = 80
"""On a narrower terminal the help is plain: its panels would cut the names of options short."""

app = typer.Typer(
    name="scanweld",
    help="Register point sets and build dense 3-D maps from RGB-D video.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich" if shutil.get_terminal_size().columns >= PANEL_COLUMNS else None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _stoppable(command: Callable[..., int]) -> Callable[..., int]:
    """Say that Ctrl-C ended a command: Typer turns it into an exit code without a word."""

    @functools.wraps(command)
    def call(*arguments: Any, **options: Any) -> int:
        try:
            return command(*arguments, **options)
        except KeyboardInterrupt as end:
            return _interrupted(end)

    return call


def _interrupted(end: BaseException) -> int:
    """Say that a command was ended, and what the command itself knows of what it has kept; return the exit code."""
    print(f"interrupted; {end}" if str(end) else "interrupted", file=sys.stderr)
    return 130


for command in (
    demo,
    check,
    slam,
    batch,
    register,
    evaluate,
    render,
    repeat,
    report,
    view,
    mesh,
    config,
    datasets,
    bench,
    warmup,
    completion,
):
    app.command(help=help_of(command), epilog=examples_of(command.__name__))(_stoppable(command))


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Register point sets and build dense 3-D maps from RGB-D video."""
    if version:
        from importlib.metadata import version as installed

        typer.echo(installed("scanweld"))
        raise typer.Exit


class _LowerCaseLevel(logging.Formatter):
    """Log lines look like error lines: "warning: ..."."""

    def format(self, record: logging.LogRecord) -> str:
        record.level = record.levelname.lower()
        return super().format(record)


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_LowerCaseLevel("%(level)s: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    command = typer.main.get_command(app)
    try:
        code = command.main(list(arguments), prog_name="scanweld", standalone_mode=False)
    except ScanweldError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, typer.Abort) as end:
        return _interrupted(end)
    except BrokenPipeError:
        _drop_output()
        return 0
    except SystemExit as end:  # by this the parser tells of a closed pipe, and ends what it does by itself
        if end.code != 1:
            raise
        _drop_output()
        return 0
    except OSError as error:  # what the library does not expect: standard output on a full disk, too many open files
        _drop_output()
        print(f"error: {error}", file=sys.stderr)
        return 1
    except Exception as error:
        # Usage errors of the parser carry their exit code and know how to show themselves.
        show = getattr(in_plain_words(error), "show", None)
        if show is None:
            raise
        show()
        return int(getattr(error, "exit_code", 2))
    return int(code or 0)


def _drop_output() -> None:
    """Let the rest of standard output vanish: nobody takes it, and no traceback is wanted at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
