"""Delay of the stamps of scans against those of the odometry, from the turns of the robot."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.odometry import OdometryBuffer
from thinmap_ros.core.scan import Scan, delayed_ns
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.stage import Estimate

# Of the delays that are tried, to either side.
_MAX_S = 0.5
_STEP_S = 0.005
_TURN_RAD = (0.01, 2.0)  # least and largest turn with one of them that is compared
_MIN_PERIOD_S = 0.1  # over which a turn is larger than the error of a match
_MAX_PERIOD_S = 1.5
_TURNS = 200  # that are compared, the last ones
# Their residual is at least this, with tails of a Student distribution of so much freedom.
_MIN_SIGMA_RAD = 0.003
_FREEDOM = 4.0
# Residuals of neighbouring turns are correlated: this share of them counts, and the estimates
# without each of some parts show what that leaves open.
_INDEPENDENCE = 0.25
_BLOCKS = 8
# Beyond which a delay is certain: where odometry comes as seldom as scans, estimates were up to 3.4
# of them off.
_CERTAIN_SIGMAS = 4.0
_LEAST_S = 0.02  # a smaller delay turns no scan by more than the angle between two beams
_REFINED_RATIO = 0.7  # of the standard deviation, with which an estimate is followed


@dataclass(frozen=True)
class Delay:
    """Delay of the stamps of scans, and its standard deviation, s; infinite: unknown."""

    seconds: float
    sigma_s: float


_ITERATIONS = 4
_EDGE = 0.01  # probability of the largest delays that are tried, beyond which it may be larger


class DelayEstimator:
    """Estimates by how much later the stamps of a laser's scans are than their measurement.

    A driver may stamp a scan when it is received, and two machines have two clocks. Matching shows
    the turn between two scans. With the right delay it is the turn of the odometry between both,
    but for the scale of the odometry. A turn that does not begin or end shows no delay.

    applied: the delay that is corrected, besides the given one; one that is certain. It follows
    estimates that are more certain. Matches with an odometry of another delay are forgotten.
    """

    def __init__(self) -> None:
        count = round(_MAX_S / _STEP_S)
        self._tried_s = _STEP_S * np.arange(-count, count + 1, dtype=np.float64)
        self.applied = Delay(0.0, math.inf)
        self._given_s = 0.0
        self._forget()

    @property
    def total_s(self) -> float:
        """Delay of the scans: the given one, and the one that is applied besides, s."""
        return self._given_s + self.applied.seconds

    @property
    def warning(self) -> str:
        """What is wrong, and what to set; '' while no delay is certain."""
        if not math.isfinite(self.applied.sigma_s):
            return ''
        late, other = ('scans', 'odometry') if self.total_s > 0.0 else ('odometry', 'scans')
        return (
            f'stamps of the {late} are {abs(self.total_s):.2f} s (sigma '
            f'{self.applied.sigma_s:.2f} s) later than those of the {other}: by the turns of '
            f'both; corrected: stamp at the measurement, or set scan_delay_s: {self.total_s:.2f}'
        )

    def with_delay(self, scan: Scan) -> Scan:
        """A scan that has the given delay, with the total one."""
        self._given_s = scan.delay_s
        return replace(scan, delay_s=self.total_s) if self.applied.seconds else scan

    def add(self, scan: Scan, estimate: Estimate, odometry: OdometryBuffer) -> None:
        """Add a scan of `with_delay`, and its estimate.

        A pose that no match has set, or that a loop closure has moved, shows no turn.
        """
        is_moved = estimate.correction is not None or estimate.odometry_discontinuity
        is_matched = estimate.scan_information is not None and not is_moved
        heading = float(estimate.T_map_base[2]) if is_matched else None
        self._waiting.append((delayed_ns(scan.stamp_ns, self._given_s), heading))
        latest_ns = odometry.latest_stamp_ns
        ahead_ns = 2.0 * _MAX_S * SECOND_NS
        if latest_ns is not None and self._waiting[0][0] > latest_ns + ahead_ns:
            self._waiting.clear()  # of a clock that was set back since
        while self._waiting and self._is_covered(self._waiting[0][0], odometry):
            self._compare(*self._waiting.popleft(), odometry)

    def _forget(self) -> None:
        self._waiting: deque[tuple[int, float | None]] = deque()
        self._last: tuple[int, float] | None = None
        self._found: deque[float] = deque(maxlen=_TURNS)
        self._expected: deque[Array] = deque(maxlen=_TURNS)
        self._added = 0

    def _is_covered(self, stamp_ns: int, odometry: OdometryBuffer) -> bool:
        """Whether the odometry has arrived for all delays that are tried."""
        latest_ns = odometry.latest_stamp_ns
        return latest_ns is not None and stamp_ns + _MAX_S * SECOND_NS <= latest_ns

    def _compare(self, stamp_ns: int, heading: float | None, odometry: OdometryBuffer) -> None:
        """Compare the turn since the previous scan with those of the odometry."""
        last = self._last
        since_s = 0.0 if last is None else (stamp_ns - last[0]) / SECOND_NS
        if last is not None and heading is not None and 0.0 <= since_s < _MIN_PERIOD_S:
            return
        self._last = None if heading is None else (stamp_ns, heading)
        if last is None or heading is None or not 0.0 < since_s <= _MAX_PERIOD_S:
            return
        tried_ns = np.rint(self._tried_s * SECOND_NS).astype(np.int64)
        headings = odometry.headings(np.concatenate([last[0] - tried_ns, stamp_ns - tried_ns]))
        if headings is None:
            return
        before, after = headings.reshape(2, -1)
        largest = float(np.abs(after - before).max())
        if _TURN_RAD[0] <= largest <= _TURN_RAD[1]:
            self._add_turn(float(se2.wrap(heading - last[1])), after - before)

    def _add_turn(self, found: float, expected: Array) -> None:
        """Add a turn (rad) by matching and those of the odometry for all delays (K,)."""
        self._found.append(found)
        self._expected.append(expected)
        self._added += 1
        if len(self._found) >= 2 * _BLOCKS and self._added % _BLOCKS == 0:
            found_rad = np.array(self._found)
            self._apply(estimated(found_rad, np.array(self._expected), self._tried_s))

    def _apply(self, delay: Delay) -> None:
        change_s = abs(delay.seconds - self.applied.seconds)
        is_other = change_s > max(_CERTAIN_SIGMAS * delay.sigma_s, _LEAST_S)
        is_known = math.isfinite(self.applied.sigma_s)
        is_better = is_known and delay.sigma_s < _REFINED_RATIO * self.applied.sigma_s
        if is_other or is_better:
            self.applied = delay
        if is_other:
            self._forget()


def estimated(found: Array, expected: Array, tried_s: Array) -> Delay:
    """Delay by turns (N,) of scans and those of the odometry (N, K) for all delays tried_s (K,).

    Each delay has a scale of the odometry of its own, of weighted least squares. The mean of the
    delays by their likelihood is the estimate; it has the variance of their likelihood, and that of
    the estimates without one of the parts of the drive.
    Source: Quenouille, "Notes on bias in estimation", 1956, for the latter (jackknife).
    """
    cost = _INDEPENDENCE * _costs(found[:, None], expected)
    parts = np.array([part.sum(axis=0) for part in np.array_split(cost, _BLOCKS)])
    mean_s, variance = _moments(parts.sum(axis=0), tried_s)
    without = np.array([one[0] for one in _without_each(parts, tried_s)])
    variance += (_BLOCKS - 1) * float(without.var())
    return Delay(mean_s, math.sqrt(variance))


def _costs(found: Array, expected: Array) -> Array:
    """Negative log likelihood (N, K) of each turn for each delay."""
    weights = np.ones_like(expected)
    for _ in range(_ITERATIONS):
        squares = (weights * expected**2).sum(axis=0) + 1e-6
        scale = (weights * found * expected).sum(axis=0) / squares
        squared = (found - scale * expected) ** 2
        # The median of the squares of a normal distribution is its variance by 2.2.
        smallest = 2.2 * float(np.median(squared, axis=0).min())
        relative = squared / (_FREEDOM * max(smallest, _MIN_SIGMA_RAD**2))
        weights = 1.0 / (1.0 + relative)
    return np.asarray(0.5 * (_FREEDOM + 1.0) * np.log1p(relative))


def _without_each(parts: Array, tried_s: Array) -> Iterator[tuple[float, float]]:
    total = parts.sum(axis=0)
    for part in parts:
        yield _moments(total - part, tried_s)


def _moments(cost: Array, tried_s: Array) -> tuple[float, float]:
    """Mean (s) and variance of delays (K,) by their cost; infinite if it may be beyond them."""
    share = np.exp(cost.min() - cost)
    share /= share.sum()
    mean_s = float(share @ tried_s)
    is_beyond = max(share[0], share[-1]) > _EDGE
    spread = float(share @ np.square(tried_s - mean_s))
    return mean_s, math.inf if is_beyond else spread
