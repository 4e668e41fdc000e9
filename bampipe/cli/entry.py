"""The entry point: what signals and errors mean to whoever called the program."""

from __future__ import annotations

import os
import signal
import sys


def main() -> None:
    """Run the command line: a user's mistake is one line on standard error and exit code 2.

    SIGTERM ends a command as Ctrl-C does: what is under way is given up, workers end, locks are
    released; the exit code is 128 and the number of the signal.
    """
    received: list[int] = []

    def stop(number: int, _: object) -> None:
        received.append(number)
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        _run()
    except BaseException as error:
        if not received or (isinstance(error, SystemExit) and not error.code):
            raise
        print("bampipe: stopped; the same command goes on from here", file=sys.stderr, flush=True)
        # No joining of threads and processes at exit: nothing is left that could be lost.
        os._exit(128 + received[0])


def _run() -> None:
    # Slow to import: only once signals are answered.
    from bampipe.cli import show
    from bampipe.cli.app import app
    from bampipe.errors import InputError

    try:
        app()
    except InputError as error:
        show.note(f"bampipe: error: {error}")
        sys.exit(2)
    except BrokenPipeError:
        # Whoever read our output has closed it (`bampipe effects | head`): leave without noise.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
