"""Progress of a run: bars on a terminal, anywhere else a line per phase and minute."""

import threading
import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from experiments import health
from experiments.tensorboard import Events
from experiments.training import Watcher


class Phases:
    """Progress of named phases while it is entered.

    Args:
      console: where it is shown.
      every: seconds between two lines of the same phase where ``console`` is no terminal.
    """

    def __init__(self, console: Console, *, every: float = 60.0):
        self.console = console
        self._every, self._began = every, time.monotonic()
        self._bars: dict[str, Any] = {}
        self._phase, self._state, self._printed = "", "", ""
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._progress = Progress(*_COLUMNS, console=console) if console.is_terminal else None
        self._ticker = threading.Thread(target=self._tick, name="essjax-phases", daemon=True)

    def __enter__(self):
        (self._progress or self._ticker).start()
        return self

    def __exit__(self, *error):
        if self._progress:
            self._progress.stop()
            return
        self._stop.set()
        self._ticker.join()
        with self._lock:
            self._print_line()

    def show(self, phase: str, fraction: float | None = None, text: str = "") -> None:
        """Say where ``phase`` is: the fraction that is done, in [0, 1], if it is known, and what it is doing."""
        if self._progress:
            if phase not in self._bars:
                self._bars[phase] = self._progress.add_task(phase, total=None, text="")
            self._progress.update(self._bars[phase], total=fraction and 1.0, completed=fraction or 0.0, text=text)
            return
        with self._lock:
            if phase != self._phase:
                self._print_line()  # how the phase before ended
            new, self._phase = phase != self._phase, phase
            self._state = f"{phase}: {'' if fraction is None else f'{100 * fraction:.0f} % '}{text}".rstrip(": ")
            if new:
                self._print_line()

    def _tick(self) -> None:
        while not self._stop.wait(self._every):
            with self._lock:
                self._print_line(again=True)

    def _print_line(self, *, again: bool = False) -> None:
        """Print the state with the time since the start; the same one twice only where it is asked for ``again``."""
        if self._state and (again or self._state != self._printed):
            minutes, seconds = divmod(int(time.monotonic() - self._began), 60)
            line = f"{minutes:3d}:{seconds:02d} {self._state}"
            self.console.print(line, markup=False, highlight=False, soft_wrap=True)
            self._printed = self._state


_COLUMNS = (
    TextColumn("{task.description:<16}"),
    BarColumn(),
    TextColumn("{task.fields[text]}", markup=False),  # names of sequences may have brackets
    TimeElapsedColumn(),
)


class TrainingProgress(Watcher):
    """Shows the steps of stages; says at once where the gradient stays zero."""

    def __init__(self, phases: Phases, prefix: str, events: Events | None = None):
        self.phases, self.prefix, self.events, self.still = phases, prefix, events, 0

    def close(self) -> None:
        """Write what is left."""
        if self.events:
            self.events.close()

    def on_compile(self, stage):
        """Say on the bar that it waits."""
        self.still = 0
        self.phases.show(f"train {self.prefix}{stage}", text="compiling (the clock of the training waits)")

    def on_step(self, stage, step, progress, terms):
        """Move the bar; a network that is dead by now is named."""
        self.still = 0 if terms["gradient_norm"] else self.still + 1
        self.phases.show(f"train {self.prefix}{stage}", progress, f"step {step}, loss {terms['loss']:.4f}")
        if self.events:
            self.events.add(stage, step, terms, group="train")
        if self.still == health.STILL_STEPS:
            self.phases.console.print(
                f"Dead network: {self.prefix}{stage}: the gradient is exactly zero since step "
                f"{step - self.still + 1}. A smaller learning rate may keep it alive.", style="red", soft_wrap=True,
            )  # fmt: skip

    def on_validation(self, stage, step, progress, scores):
        """Show the scores on the bar."""
        found = ", ".join(f"{kind.upper()} {value:.2f} dB" for kind, value in scores.items()) or "validating"
        self.phases.show(f"train {self.prefix}{stage}", progress, f"step {step}, {found}")
        if self.events:
            self.events.add(stage, step, scores, group="validation")
