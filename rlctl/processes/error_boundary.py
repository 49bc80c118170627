"""Turns exceptions into messages and exit codes; handles streams that are closed or not UTF-8."""

import contextlib
import errno
import os
import sys
from collections.abc import Callable

from rlctl.errors import RlctlError, explain_left_out, short_repr
from rlctl.version import __version__

INTERRUPTED = 130  # exit code after Ctrl-C
EXIT_S = 10.0  # time limit of exit handlers [s]
_LONGEST_LINE = 1500  # [characters] of an error message
_NO_MEMORY = ("failed to map segment", "cannot allocate memory", "can't allocate memory", "not enough memory")


def run(main: Callable[[], int]) -> int:
    """Call `main` and return its exit code; print an exception and return the exit code that belongs to it."""
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
        if isinstance(end.__context__, BrokenPipeError):  # Typer and Rich convert it
            close_stdout()
            return 141
        raise
    except Exception as error:
        return report_unexpected(error)


def prepare_streams() -> None:
    """Open a stderr if there is none; let streams that are not UTF-8 replace characters instead of raising."""
    if sys.stderr is None:
        descriptor = os.open(os.devnull, os.O_WRONLY)
        if descriptor != 2:
            os.dup2(descriptor, 2)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="replace")
    for stream in (sys.stdout, sys.stderr):
        if stream is not None and not (stream.encoding or "").lower().startswith("utf"):
            with contextlib.suppress(AttributeError, ValueError):  # a replacement of a test
                stream.reconfigure(errors="replace")  # type: ignore[union-attr]


def flush() -> None:
    """Flush stdout; raises `BrokenPipeError` if its reader has closed it."""
    from rlctl import output

    if sys.stdout is not None and not sys.stdout.closed:  # a plugin may have closed it
        sys.stdout.flush()
    if output.results.cache_info().currsize:
        output.results().flush()


def close_stdout() -> None:
    """Discard the buffer of a closed stdout, so that the interpreter does not raise when it exits."""
    from rlctl import output

    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    if output.results.cache_info().currsize:
        os.dup2(nowhere, output.results().fileno())


def limit_exit_handlers(code: int) -> None:
    """End the process with `code` after `EXIT_S`, even if exit handlers of plugins or libraries still run."""
    import threading

    def leave() -> None:
        print(f"warning: an exit handler did not finish within {EXIT_S:g} s; exiting without it", file=sys.stderr)
        sys.stderr.flush()
        os._exit(code)

    timer = threading.Timer(EXIT_S, leave)
    timer.daemon = True  # Python joins other threads before the exit handlers run
    timer.start()


def report(error: RlctlError) -> int:
    """Print an error of rlctl; return its exit code."""
    from rlctl.output import escape_controls

    if error.details:
        print(escape_controls(error.details.rstrip()), file=sys.stderr)
    # A file may contain a number of hundreds of digits, which the message repeats.
    first, *rest = (short_repr(line, _LONGEST_LINE) for line in escape_controls(str(error)).split("\n"))
    print(f"error: {first}", *rest, sep="\n", file=sys.stderr)
    return error.exit_code


def report_unexpected(error: Exception) -> int:
    """Print any other exception; return the exit code."""
    if (format_message := getattr(error, "format_message", None)) is not None:  # Typer's own usage errors
        command = getattr(getattr(error, "ctx", None), "command_path", "rlctl")
        is_help = type(error).__name__ == "NoArgsIsHelpError"
        message = format_message().replace(": Value error, ", ": ", 1)  # Typer adds the type of a converter's exception
        text = f"error: {short_repr(message, _LONGEST_LINE)}\n{command} --help lists what it takes"
        print(format_message() if is_help else text, file=sys.stderr)
        return 2
    if _is_out_of_memory(error):
        text = short_repr(str(error), 120)
        print(f"error: not enough memory{text and f': {text}'}", file=sys.stderr)
        print("close other programs, or use fewer --n-envs or a smaller algo_kwargs.buffer_size", file=sys.stderr)
        return 5
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename else ""
        print(f"error: {place}{error.strerror}", file=sys.stderr)
        if error.errno == errno.EFBIG:
            print(_explain_file_limit(), file=sys.stderr)
        return 5
    if isinstance(error, ModuleNotFoundError) and (missing := explain_left_out(error.name)):
        print(f"error: {missing}", file=sys.stderr)
        return 2
    import traceback

    traceback.print_exc()
    print(f"error: a bug in rlctl {__version__} or a library; please report it with the lines above", file=sys.stderr)
    return 70


def _explain_file_limit() -> str:
    """Return what limits the size of files, the process or the file system."""
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    if limit == resource.RLIM_INFINITY:
        return "the file system takes no files of this size"
    return f"files of this process may have {limit:,} bytes; raise that limit: ulimit -f unlimited"


def _is_out_of_memory(error: BaseException | None) -> bool:
    while error is not None:
        text = str(error).lower()
        refused = isinstance(error, ImportError | OSError | RuntimeError) and any(words in text for words in _NO_MEMORY)
        if isinstance(error, MemoryError) or refused:
            return True
        error = error.__cause__ or error.__context__
    return False
