"""Ctrl-C and SIGTERM: what is in hand is finished, all else ends at once; a line says how to go on; 130 or 143."""

import os
import re
import signal
import subprocess
import sys
import textwrap
import time

import jax
import numpy as np
import pytest

from essjax.stopping import Interrupted, finishing, stoppable
from essjax.train import Validation
from tests.train import tiny_run

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}


def start(body, before=""):
    """A Python process that runs ``body`` as a command, in an own session like a terminal's foreground job."""
    script = textwrap.dedent("""
        import sys, time
        from essjax.stopping import finishing, stoppable
        def say(text):
            print(text, flush=True)
        def command():
        BODY
        sys.exit(stoppable(command, lambda: say("waiting"), lambda text: say(text or "stopped")))
    """).replace("BODY", textwrap.indent(textwrap.dedent(body), "    "))
    command = ["sh", "-c", f'{before} exec "$@"', "sh", sys.executable, "-c", script]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def until(process, line):
    """Wait for a line of its output."""
    for found in process.stdout:
        if found.strip() == line:
            return
    raise AssertionError(f"it never said {line!r}")


# A call that does not return to Python for a minute and releases the GIL, as XLA's compiler.
BUSY = """
    import ctypes
    say("busy")
    ctypes.CDLL(None).sleep(60)
    return 0
"""


@pytest.mark.parametrize("number", CODES)
def test_heard_within_two_seconds_while_compiling(number):
    process = start(BUSY)
    until(process, "busy")
    sent = time.monotonic()
    process.send_signal(number)
    assert process.wait(30) == CODES[number] and time.monotonic() - sent < 2.0
    assert process.stdout.read() == "stopped\n"


SECTION = """
    with finishing(lambda: "saved"):
        say("busy")
        for _ in range(SECONDS * 10):
            time.sleep(0.1)
        say("finished")
    say("never")
"""


@pytest.mark.parametrize("number", CODES)
def test_what_is_in_hand_is_finished(number):
    process = start(SECTION.replace("SECONDS", "1"))
    until(process, "busy")
    process.send_signal(number)
    assert process.wait(30) == CODES[number]
    assert process.stdout.read().split() == ["waiting", "finished", "saved"]


def test_the_second_signal_ends_it_now():
    process = start(SECTION.replace("SECONDS", "60"))
    until(process, "busy")
    process.send_signal(signal.SIGTERM)
    until(process, "waiting")
    sent = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 143 and time.monotonic() - sent < 2.0  # what asked first
    assert process.stdout.read() == "stopped\n"


def test_what_is_ignored_stays_ignored():
    """As a shell starts jobs in the background, and nohup anything."""
    process = start("say('busy'); time.sleep(0.5); return 7", before="trap '' INT;")
    until(process, "busy")
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 7


def test_at_rest_it_ends_at_once():
    process = start("""
        with finishing(lambda: "saved") as section, section.at_rest():
            say("busy")
            time.sleep(60)
    """)
    until(process, "busy")
    process.send_signal(signal.SIGINT)
    assert process.wait(5) == 130 and process.stdout.read() == "stopped\n"


def test_a_command_returns_and_raises_as_if_called():
    assert stoppable(lambda: 5, print, print) == 5
    with pytest.raises(KeyError, match="as it is"):
        stoppable(lambda: {}["as it is"], print, print)
    with pytest.raises(SystemExit):
        stoppable(lambda: sys.exit(3), print, print)
    assert stoppable(lambda: stoppable(lambda: 6, print, print), print, print) == 6
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", CODES)
def test_without_a_command_a_section_listens_itself(number):
    """As scripts use ``train``: the second signal does what it does without essjax."""
    before = signal.getsignal(number)
    with pytest.raises(Interrupted, match="saved") as caught, finishing(lambda: "saved") as section:
        os.kill(os.getpid(), number)
        assert section.asked
    assert caught.value.code == CODES[number] and signal.getsignal(number) is before
    with finishing(lambda: "saved") as section:
        assert not section.asked  # forgotten
    with pytest.raises(KeyboardInterrupt), finishing(lambda: "saved"):
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), finishing(lambda: "saved") as section, section.at_rest():
        os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_in_the_last_step_is_not_swallowed(tmp_path):
    """It was: what came after the stage went on. Everything is saved, the resumed run ends the same."""

    def on_step(step, progress, terms):
        if step == tiny_run.STEPS:
            os.kill(os.getpid(), signal.SIGTERM)

    message = f"stopped at step {tiny_run.STEPS}; the state is saved. Run the same command with --resume."
    with pytest.raises(Interrupted, match=re.escape(message)) as caught:
        tiny_run.run(tmp_path / "run", on_step=on_step)
    assert caught.value.code == 143
    found, _ = tiny_run.run(tmp_path / "run", on_step=lambda *_: pytest.fail("it trained again"))
    expected, _ = tiny_run.run(tmp_path / "uninterrupted")
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_a_signal_in_a_later_validation_is_heard_after_it(tmp_path):
    """Its scores are kept with the state."""
    calls = []

    def score(variables):
        calls.append(1)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return tiny_run.validation().score(variables)

    with pytest.raises(Interrupted, match="stopped at step 6;"):
        tiny_run.run(tmp_path / "run", validation=Validation(score, 4))
    found, _ = tiny_run.run(tmp_path / "run")
    expected, _ = tiny_run.run(tmp_path / "uninterrupted")
    jax.tree.map(np.testing.assert_array_equal, found, expected)
