"""A CARMEN log of a robot in a square room."""

import numpy as np

BEAMS = 181


def box_ranges(x, theta, half=3.0):
    """Ranges of a laser in a square room around the origin."""
    angles = theta + np.radians(np.arange(BEAMS) - 90.0)
    to_x = (np.sign(np.cos(angles)) * half - x) / np.cos(angles)
    to_y = half / np.abs(np.sin(angles) + 1e-12)
    return np.minimum(np.abs(to_x), to_y)


def carmen_lines(scans=30, beams=BEAMS, start_s=0.0):
    lines = ['# a robot that drives along x through a square room']
    for k in range(scans):
        x = 0.03 * k
        stamp = start_s + 0.2 * k
        readings = ' '.join(f'{r:.3f}' for r in box_ranges(x, 0.0)[:beams])
        tail = f'{x:.4f} 0 0 {x:.4f} 0 0 {stamp:.3f} robot {stamp:.3f}'
        lines += [
            f'ODOM {x:.4f} 0 0 0.15 0 0 {stamp:.3f} robot {stamp:.3f}',
            f'FLASER {beams} {readings} {tail}',
        ]
    return lines
