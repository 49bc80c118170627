"""From an exception to what the user reads and an exit code; streams that are closed or not UTF-8."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable

from rlctl.errors import RlctlError, short_repr
from rlctl.version import __version__

INTERRUPTED = 130
"""Exit code after Ctrl-C."""
EXIT_S = 10.0
"""How long exit handlers may take [s]."""
_NO_MEMORY = ("failed to map segment", "cannot allocate memory", "can't allocate memory", "not enough memory")


def run(main: Callable[[], int]) -> int:
    """Return the exit code that `main` returns, or that of the exception that ends it, which is printed."""
    try:
        code = main()
        flush()
        return code
    except RlctlError as error:
        return report(error)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        close_stdout()
        return 141
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):  # what Typer and Rich make of it
            close_stdout()
            return 141
        raise
    except Exception as error:
        return report_unexpected(error)


def prepare_streams() -> None:
    """Make sure that there is a stderr, and that no text fails because a stream has another encoding than UTF-8."""
    if sys.stderr is None:
        descriptor = os.open(os.devnull, os.O_WRONLY)
        if descriptor != 2:
            os.dup2(descriptor, 2)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="replace")
    for stream in (sys.stdout, sys.stderr):
        if stream is not None and not (stream.encoding or "").lower().startswith("utf"):
            with contextlib.suppress(AttributeError, ValueError):  # a stream of somebody's test
                stream.reconfigure(errors="replace")  # type: ignore[union-attr]


def flush() -> None:
    """Write what is buffered for stdout; raises `BrokenPipeError` if nobody reads it."""
    from rlctl import output

    if sys.stdout is not None and not sys.stdout.closed:  # a plugin may have closed it
        sys.stdout.flush()
    if output.results.cache_info().currsize:
        output.results().flush()


def close_stdout() -> None:
    """Discard what is buffered for a stdout that was closed: it must not raise when the interpreter ends."""
    from rlctl import output

    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    if output.results.cache_info().currsize:
        os.dup2(nowhere, output.results().fileno())


def limit_exit_handlers(code: int) -> None:
    """End the process with `code` after `EXIT_S`, whatever an exit handler of a plugin or a library still does."""
    import threading

    def leave() -> None:
        print(f"warning: an exit handler did not end within {EXIT_S:g} s; leaving without it", file=sys.stderr)
        sys.stderr.flush()
        os._exit(code)

    timer = threading.Timer(EXIT_S, leave)
    timer.daemon = True  # Python waits for other threads before it calls the handlers
    timer.start()


def report(error: RlctlError) -> int:
    """Print one of our own errors; return its exit code."""
    from rlctl.output import escape_controls

    if error.details:
        print(escape_controls(error.details.rstrip()), file=sys.stderr)
    first, *rest = escape_controls(str(error)).split("\n")
    print(f"error: {first}", *rest, sep="\n", file=sys.stderr)
    return error.exit_code


def report_unexpected(error: Exception) -> int:
    """Print an exception that no part of rlctl has explained; return the exit code."""
    usage, show = getattr(error, "exit_code", None), getattr(error, "show", None)
    if usage is not None and show is not None:  # Typer's own usage errors
        show()
        return int(usage)
    if _is_out_of_memory(error):
        text = short_repr(str(error), 120)
        print(f"error: not enough memory ({_read_limit()}){text and f': {text}'}", file=sys.stderr)
        print("close other programs, or use fewer --n-envs or a smaller algo_kwargs.buffer_size", file=sys.stderr)
        return 5
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename else ""
        print(f"error: {place}{error.strerror}", file=sys.stderr)
        return 5
    import traceback

    traceback.print_exc()
    print(f"error: a bug in rlctl {__version__} or a library; please report it with the lines above", file=sys.stderr)
    return 70


def _is_out_of_memory(error: BaseException | None) -> bool:
    """Say whether memory was refused: by Python, by the loader of libraries, or by torch."""
    while error is not None:
        text = str(error).lower()
        refused = isinstance(error, ImportError | OSError | RuntimeError) and any(words in text for words in _NO_MEMORY)
        if isinstance(error, MemoryError) or refused:
            return True
        error = error.__cause__ or error.__context__
    return False


def _read_limit() -> str:
    import resource

    from rich.filesize import decimal as format_bytes

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return "the system refused more" if limit == resource.RLIM_INFINITY else f"its limit is {format_bytes(limit)}"
