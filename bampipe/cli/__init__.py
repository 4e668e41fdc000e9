"""The command line parses, calls and prints; here, errors and signals become exit codes."""

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
        print(f"bampipe: stopped{_tell_progress()}", file=sys.stderr, flush=True)
        # Threads and processes are not joined: nothing is left that could be lost.
        os._exit(128 + received[0])


def _tell_progress() -> str:
    """Say which steps of a run were under way, which results are kept, and how to resume."""
    show = sys.modules.get("bampipe.cli.show")
    known = getattr(show, "UNDER_WAY", {})
    if not known:
        return "; nothing was left half-written"
    at = ", ".join(f"{step} of {run}" for run, step in sorted(known.items()) if step)
    same = "the same command without --force" if "--force" in sys.argv else "the same command"
    kept = "every stage that had finished is kept, and"
    return f"{f' at {at}' if at else ''}; {kept} {same} goes on from there"


def _run() -> None:
    # Slow to import: only once signals are answered.
    from bampipe.cli import show
    from bampipe.cli.app import app
    from bampipe.errors import InputError

    try:
        app()
    except InputError as error:
        for line in error.lines():
            show.note(f"bampipe: error: {line}")
        sys.exit(2)
    except show.OutputClosedError:
        # Leave as other tools do, without noise.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
