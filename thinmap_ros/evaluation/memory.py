"""Resident memory of this process, now and at its peak."""

import resource
from pathlib import Path


def resident_mb() -> float:
    """Resident memory now, MB."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def peak_mb() -> float:
    """Highest resident memory since the process began or `forget_peak`, MB."""
    # Not ru_maxrss: after a fork that is at least what the parent had.
    status = Path('/proc/self/status').read_text()
    return int(status.split('VmHWM:')[1].split()[0]) * 1024 / 1e6


def forget_peak() -> None:
    """From now on the peak is that of what follows."""
    Path('/proc/self/clear_refs').write_text('5')
