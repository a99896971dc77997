"""The command `zakai`."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence

from zakai.cli import _interrupt


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default those of the process, and return the exit code.

    0 success; 2 wrong input; 3 no method holds, or not the requested one; 130 interrupted.  Any other exception is a bug and
    leaves with its traceback (1).
    """
    if arguments is None:
        # Imported modules stay: searches for garbage among them take a tenth of the time of a short command.
        gc.set_threshold(500_000, 20, 100)
        _interrupt.watch()
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        _interrupt.end()
        print("interrupted; nothing half-written was left behind", file=sys.stderr, flush=True)
        if arguments is None and "jax" in sys.modules:
            os._exit(130)  # JAX, in a filter of another library, may still be compiling and reports an orderly exit as a crash
        return 130
    except BrokenPipeError:
        _discard_output()  # the reader closed the pipe, which is no error
        return 0
    finally:
        if arguments is None:
            gc.freeze()  # Python searches for garbage at the end too


def _run(arguments: Sequence[str] | None) -> int:
    import typer

    from zakai.cli.app import app
    from zakai.errors import ZakaiError

    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a terminal without Greek letters prints question marks
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
        # Typer exits with 1 where the reader of a pipe is gone.
        if isinstance(leaving.__context__, BrokenPipeError):
            raise BrokenPipeError from None
        raise
    except BrokenPipeError:
        raise
    except OSError as error:
        # An error of a file has a name; without one it comes from print.
        if error.filename is not None:
            raise
        _discard_output()
        return _refused(f"standard output: cannot be written: {error.strerror}; free some space or choose another place", 2)
    except ZakaiError as error:
        return _refused(str(error), error.exit_code)
    except Exception as error:
        # Wrong usage, in every version of Typer and Click: only these errors format themselves.
        if not hasattr(error, "format_message"):
            raise
        return _refused(f"{error.format_message()} (zakai --help says how)", 2)


def _refused(message: str, code: int) -> int:
    lines = [" ".join(line.split()) for line in message.splitlines()]
    print("error: " + "\n".join(lines), file=sys.stderr)
    return code


def _discard_output() -> None:
    """Discard what Python would flush at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
