"""The command `zakai`."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence

from zakai import _compiled
from zakai.cli import _interrupt


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default those of the process; the exit code.

    0 done; 2 the input is wrong; 3 no method holds, or not the one that was asked for; 130 interrupted.  A bug of ours is
    any other exception, and leaves with its traceback (1).
    """
    if arguments is None:
        # What is imported stays: to look for garbage among it, again and again, takes a tenth of the start.
        gc.set_threshold(50_000, 20, 100)
        _interrupt.watch()
        _compiled.keep()
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        print("interrupted; nothing half-written was left behind", file=sys.stderr, flush=True)
        if arguments is None and "jax" in sys.modules:
            os._exit(130)  # JAX may still be compiling, and would take an orderly exit for a crash
        return 130
    except BrokenPipeError:
        _discard_output()  # the reader closed the pipe, which is no error
        return 0


def _run(arguments: Sequence[str] | None) -> int:
    import typer

    from zakai.cli.app import app
    from zakai.errors import ZakaiError

    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a terminal that has no letter for phi still gets an answer
            stream.reconfigure(errors="replace")
    try:
        code = app(arguments, prog_name="zakai", standalone_mode=False)
        if sys.stdout is not None:
            sys.stdout.flush()
        if code == 130:
            raise KeyboardInterrupt
        return int(code or 0)
    except typer.Abort:
        raise KeyboardInterrupt from None
    except SystemExit as leaving:
        # Typer leaves with 1 where the reader of a pipe is gone.
        if isinstance(leaving.__context__, BrokenPipeError):
            raise BrokenPipeError from None
        raise
    except BrokenPipeError:
        raise
    except OSError as error:
        # What is written to a file says so itself; what has no name is the output of print.
        if error.filename is not None:
            raise
        _discard_output()
        return _refused(f"standard output: cannot be written: {error.strerror}; make room or choose another place", 2)
    except ZakaiError as error:
        return _refused(str(error), error.exit_code)
    except Exception as error:
        # A wrong usage, in every version of Typer and Click: the only errors that can format themselves.
        if not hasattr(error, "format_message"):
            raise
        return _refused(f"{error.format_message()} (zakai --help says how)", 2)


def _refused(message: str, code: int) -> int:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return code


def _discard_output() -> None:
    """What Python would still flush at its end goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
