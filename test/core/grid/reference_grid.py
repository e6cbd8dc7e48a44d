"""Reference implementation of the occupancy grid: slow and simple.

A dictionary of cells; beams are processed one by one.
"""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import P_MAX, P_MIN, PAPER_GRID, log_odds

FLAT_M = 0.06
LONGEST_SURFACE_M = 3.0
GRAZED_M = 0.4
SURELY_OCCUPIED = 0.9


def crossed(start, end):
    """Cells (row, col) of a segment (x, y) to (x, y).

    Those at the midpoints between its crossings of cell boundaries.
    """
    shares = [0.0, 1.0]
    for a, b in zip(start, end, strict=True):
        borders = np.arange(math.ceil(min(a, b)), math.floor(max(a, b)) + 1)
        shares += [] if a == b else ((borders - a) / (b - a)).tolist()
    shares = np.unique(shares)
    middles = (shares[:-1] + shares[1:]) / 2.0
    points = np.asarray(start) + middles[:, None] * np.subtract(end, start)
    return {(row, col) for col, row in np.floor(points).astype(int).tolist()}


class PlainGrid:
    """Log odds, in thousandths, of the observed cells (row, col)."""

    def __init__(self, config=None):
        self.config = config or PAPER_GRID
        self.odds = {}

    def thousandths(self, probability):
        """Log odds as stored."""
        return round(1000.0 * log_odds(probability))

    def update(self, scan, T_map_base):
        """Add a scan at a robot pose T_map_base (3,)."""
        T = se2.compose(T_map_base, scan.T_base_laser)
        self.laser = (T[0] / self.config.resolution_m, T[1] / self.config.resolution_m)
        ends = [self.end_of(scan, i, T[2]) for i in range(scan.ranges_m.size)]
        passed = set()
        surface = set()
        for i, end in enumerate(ends):
            if end is not None:
                passed |= crossed(self.laser, end)
            if i > 0 and (self.is_flat(scan, i) or self.is_flat(scan, i - 1)):
                surface |= crossed(ends[i - 1], end)
        hit = {
            (math.floor(ends[i][1]), math.floor(ends[i][0]))
            for i in range(len(ends))
            if self.is_hit(scan, i)
        }
        spared = {cell for cell in passed - hit if self.is_grazed(cell)}
        for cell in hit:
            self.add(cell, self.thousandths(self.config.p_hit))
        for cell in passed - hit - surface - spared:
            self.add(cell, self.thousandths(self.config.p_miss))

    def is_hit(self, scan, i):
        """Whether a beam has a hit within the usable range."""
        return (
            0 <= i < scan.ranges_m.size and scan.returned[i] and scan.ranges_m[i] < scan.max_range_m
        )

    def end_of(self, scan, i, heading):
        """End (x, y) of a beam, in cells; None for an uninformative beam."""
        config = self.config
        length = 0.0
        if self.is_hit(scan, i):
            length = min(scan.ranges_m[i] + config.surface_thickness_m, scan.max_range_m)
        elif scan.returned[i]:
            length = scan.max_range_m
        elif scan.no_return[i]:
            length = min(config.no_return_clear_range_m, scan.range_max_m, scan.max_range_m)
        angle = heading + scan.angles_rad[i]
        reach = length / config.resolution_m
        return (
            (self.laser[0] + reach * math.cos(angle), self.laser[1] + reach * math.sin(angle))
            if length
            else None
        )

    def is_flat(self, scan, i):
        """Whether a beam and those beside it end on one straight surface."""
        if not (self.is_hit(scan, i - 1) and self.is_hit(scan, i) and self.is_hit(scan, i + 1)):
            return False
        before, between, after = scan.ranges_m[i - 1 : i + 2]
        foretold = before * after * 2.0 * math.cos(scan.angle_increment_rad) / (before + after)
        return abs(between - foretold) < FLAT_M and abs(after - before) < LONGEST_SURFACE_M

    def is_grazed(self, cell):
        """Whether a cell is certainly occupied, and others in line with it along the beam."""
        config = self.config
        sure = min(self.thousandths(SURELY_OCCUPIED), self.thousandths(P_MAX))
        if self.odds.get(cell, 0) < sure:
            return False
        away = np.array([cell[0] + 0.5 - self.laser[1], cell[1] + 0.5 - self.laser[0]])
        step = away / np.abs(away).max()
        run = 1
        for sign in (-1, 1):
            k = 1
            while (
                self.odds.get(
                    (cell[0] + round(sign * k * step[0]), cell[1] + round(sign * k * step[1])), 0
                )
                >= sure
            ):
                run = run + 1
                k = k + 1
        return run >= max(3, round(GRAZED_M / config.resolution_m))

    def add(self, cell, step):
        """Bayes' rule for one cell.

        Even odds are stored as one thousandth, because 0 is an unobserved cell.
        """
        low = self.thousandths(P_MIN)
        high = self.thousandths(P_MAX)
        self.odds[cell] = min(max((self.odds.get(cell, 0) + step) or 1, low), high)
