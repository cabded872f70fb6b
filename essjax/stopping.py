"""Signals: Ctrl-C and SIGTERM end a command where nothing is lost, whatever it is doing.

The first one: what is in hand (a ``finishing`` section) is finished and saved, then the command ends; outside of such a
section nothing would be lost, and it ends at once. The second one: it ends now.

Python hears signals in the main thread, between two of its own instructions; XLA compiles for a minute without any. So
a command runs in another thread (``stoppable``), and the main one only listens.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_POLL = 0.1
"""Seconds after which the main thread looks at what it heard."""
_UNWIND = 1.0
"""Seconds that a command has from the end of its section to its own end."""
_STACK = 64 << 20
"""Bytes of the command's stack, where some systems give 512 kB to a thread: tracing nests deeply."""


class Interrupted(RuntimeError):
    """A signal asked to stop: what was in hand is finished and saved.

    Attributes:
      code: exit code, 128 and the signal's number.
    """

    def __init__(self, text: str, code: int = 128 + signal.SIGINT):
        super().__init__(text)
        self.code = code


class _Ears:
    """What was heard, and whether something is in hand; one per process, as signals are."""

    def __init__(self):
        self.lock = threading.RLock()
        self.heard: list[int] = []  # numbers of the signals
        self.sections = 0
        self.command = False  # ``stoppable`` listens
        self.ended = 0.0  # when a section raised ``Interrupted``


_ears = _Ears()


class finishing:  # noqa: N801  a context manager, as contextlib names them
    """A section that the first signal does not tear: ``Interrupted`` is raised at its end.

    Where no command runs (``stoppable``), it listens itself while it is entered in the main thread.
    """

    def __init__(self, saved: Callable[[], str]):
        """Take ``saved``, which says at the end what there is, and how to go on."""
        self._saved = saved

    def __enter__(self):
        with _ears.lock:
            if _ears.command and _ears.heard:
                self._raise()
            _ears.sections += 1
        self._before = {} if _ears.command else _listen(_remember)
        return self

    @property
    def asked(self) -> bool:
        """Whether it should come to its end."""
        return bool(_ears.heard)

    @contextlib.contextmanager
    def at_rest(self) -> Iterator[None]:
        """While it is entered nothing is in hand: a signal ends the command at once."""
        self._leave()
        try:
            if self.asked:
                self._raise()
            yield
        finally:
            with _ears.lock:
                _ears.sections += 1
            self._before = {} if _ears.command else _listen(_remember)

    def _leave(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        with _ears.lock:
            _ears.sections -= 1

    def _raise(self) -> None:
        number, _ears.ended = _ears.heard[0], time.monotonic()
        if not _ears.command and not _ears.sections:
            _ears.heard.clear()
        raise Interrupted(self._saved(), 128 + number)

    def __exit__(self, kind, error, trace):
        self._leave()
        if self.asked and kind is None:
            self._raise()
        if not _ears.command and not _ears.sections:
            _ears.heard.clear()


def _listen(handler: Callable[[int, Any], None]) -> dict[int, Any]:
    """Let ``handler`` hear the signals, but for those that are ignored (nohup, a job of a shell); what was before."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    chosen = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in chosen}


def _remember(number: int, stack: Any) -> None:
    """Hear a signal outside a command: the second one does what it always does."""
    _ears.heard.append(number)
    if len(_ears.heard) > 1:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        os.kill(os.getpid(), number)


def stoppable(command: Callable[[], int], waiting: Callable[[], Any], stopped: Callable[[str], Any]) -> int:
    """Run ``command`` in a thread, while this one listens; returns its exit code, raises what it raises.

    After a signal the process ends here: Python would wait for threads that compile.

    Where it is not called in the main thread, or in another command, it just runs it.

    Args:
      command: may raise ``Interrupted`` from its sections.
      waiting: called when a signal came and something is in hand.
      stopped: called when the process ends because of a signal, with 128 and its number: says how to go on; it is
        given what the section says that was in hand, or "".
    """
    if threading.current_thread() is not threading.main_thread() or _ears.command:
        return command()
    outcome: dict[str, Any] = {}

    def work() -> None:
        try:
            outcome["code"] = command()
        except BaseException as error:  # noqa: BLE001  raised again below
            outcome["error"] = error

    def leave(text: str = "") -> None:
        if len(_ears.heard) < 3:  # the third one does not wait for a terminal either
            for each in (lambda: stopped(text), sys.stdout.flush, sys.stderr.flush):
                with contextlib.suppress(Exception):
                    each()
        os._exit(128 + _ears.heard[0])

    def hear(number: int, stack: Any) -> None:
        _ears.heard.append(number)
        if len(_ears.heard) > 1:
            leave()

    threading.stack_size(_STACK)
    thread = threading.Thread(target=work, name="essjax-command", daemon=True)
    _ears.command, told, before = True, False, _listen(hear)
    try:
        thread.start()
        threading.stack_size(0)
        while thread.is_alive():
            thread.join(_POLL)
            if _ears.heard:
                with _ears.lock:  # nothing begins meanwhile
                    if thread.is_alive() and not _ears.sections and time.monotonic() - _ears.ended > _UNWIND:
                        leave()
                if not told and _ears.sections:
                    told = True
                    waiting()
        if isinstance(outcome.get("error"), Interrupted) and _ears.heard:
            leave(str(outcome["error"]))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _ears.command = False
        _ears.heard.clear()
    if "error" in outcome:
        raise outcome["error"]
    return outcome["code"]
