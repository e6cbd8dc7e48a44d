"""Runs the small `ros2` for machines without ROS."""

import subprocess
import sys
from pathlib import Path

from support.timeouts import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
ROS2 = ROOT / 'scripts' / 'shim' / 'ros2'


def start(*words):
    return subprocess.Popen(
        [sys.executable, str(ROS2), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(*words):
    process = start(*words)
    try:
        stdout, stderr = process.communicate(timeout=2.0 * PATIENCE_S)
    finally:
        process.kill()
    assert 'Traceback' not in stderr
    return subprocess.CompletedProcess(words, process.returncode, stdout, stderr)


def output(*words):
    done = run(*words)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return done.stdout
