"""Runs the steps that are not finished, each with a time limit and a file of its output."""

import os
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.release.state import Finished, State, write_state
from benchmarks.release.steps import Step

_END_S = 30.0  # to end after Ctrl-C, before it is killed


def run_steps(chosen: Sequence[Step], folder: Path, state: State, limit_s: float) -> dict[str, str]:
    """Run the steps without a result, and write the state after each. Returns what failed, and why.

    limit_s: of all steps together; the step that runs then ends. Ctrl-C ends the step that runs,
    and is raised again; the steps before stay finished.
    """
    failed: dict[str, str] = {}
    end = time.monotonic() + limit_s
    for number, step in enumerate(chosen, 1):
        head = f'[{number}/{len(chosen)}] {step.name}'
        if step.name in state.steps:
            print(f'{head}: finished before, {state.steps[step.name].seconds:.0f} s', flush=True)
            continue
        print(f'{head}: some {step.minutes} min', flush=True)
        began = time.monotonic()
        reason = _attempt(step, folder, state, end - began)
        seconds = time.monotonic() - began
        if reason:
            failed[step.name] = reason
            print(f'{head}: failed: {reason}', flush=True)
            continue
        ended = datetime.now(UTC).isoformat(timespec='seconds')
        state.steps[step.name] = Finished(list(step.command), round(seconds, 1), ended)
        write_state(folder, state)
        print(f'{head}: {seconds:.0f} s', flush=True)
    return failed


def _attempt(step: Step, folder: Path, state: State, left_s: float) -> str:
    """Run a step if what it needs is there and time is left. Returns why it failed, or nothing."""
    missing = [name for name in step.needs if name not in state.steps]
    if missing:
        return f'needs {", ".join(missing)}'
    if left_s <= 0.0:
        return 'no time is left: the same command continues'
    return run_step(step, folder / 'logs' / f'{step.name}.txt', min(step.limit_s, left_s))


def run_step(step: Step, log: Path, limit_s: float) -> str:
    """Run a step with its output in a file. Returns why it failed, or an empty text."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open('wb') as output:
        # A session of its own: all that the step has started ends with it.
        process = subprocess.Popen(
            step.command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(timeout=limit_s)
        except subprocess.TimeoutExpired:
            return f'not finished after {limit_s:.0f} s'
        finally:
            _end(process)
    if code == 0:
        return ''
    lines = log.read_text(encoding='utf-8', errors='replace').strip().splitlines()
    return f'exit code {code}: {lines[-1] if lines else "no output"}'


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and all of its session, as by Ctrl-C, then by force."""
    if process.poll() is not None:
        return
    os.killpg(process.pid, signal.SIGINT)
    with suppress(subprocess.TimeoutExpired):
        process.wait(timeout=_END_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
