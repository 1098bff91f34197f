"""`scanweld warmup`: compile the kernels before they are needed."""

from __future__ import annotations

import json
import os
import time
from typing import Annotated

import typer


def warmup(
    json_output: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> int:
    """Compile the kernels of the SLAM loop, once for this machine and version; `slam` and `demo` do so by themselves.

    They are kept in the cache folder that is printed; NUMBA_CACHE_DIR names another one.
    """
    started = time.perf_counter()
    from scanweld.cli.progress import CountProgress
    from scanweld.slam.warmup import compile_kernels

    with CountProgress() as progress:
        compiled = compile_kernels(lambda part: progress.begin(f"compiling: {part}"))
    seconds, folder = time.perf_counter() - started, os.environ["NUMBA_CACHE_DIR"]
    if json_output:
        typer.echo(json.dumps({"compiled": compiled, "seconds": seconds, "cache": folder}))
    elif compiled:
        typer.echo(f"compiled in {seconds:.1f} s, kept in {folder}")
    else:
        typer.echo(f"nothing to compile: the kernels are in {folder}")
    return 0
