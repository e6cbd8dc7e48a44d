"""Motion by odometry for motion by scan matching, and what to set in the driver of the base."""

import math
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from statistics import median

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array, rotation

# A span ends after so much motion by matching, beside which the errors of its ends are small.
_SPAN_M = 0.5
_SPAN_RAD = 0.3
_TURN_RAD = (0.2, 1.5)  # of a span whose turn counts: a larger one may be ambiguous
# Least and largest number of spans of each kind.
_LEAST_SPANS = 6
_MOST_SPANS = 50
_MAX_SIGMA_M = 0.03  # of matches that count: along a corridor they follow the odometry
_COMMON = 0.01  # standard deviation of an error that all matches have
# Deviation that is reported. Wheels and wheel bases are measured to some percent, which the
# calibration of the odometry corrects.
_CONSIDERABLE = 0.1
# Other ratios are those of an odometry that does not move, or of other units.
_POSSIBLE = (0.2, 5.0)


@dataclass(frozen=True)
class Ratio:
    """Motion by odometry for motion by matching, and its standard deviation."""

    value: float
    sigma: float

    @property
    def text(self) -> str:
        """The deviation in percent."""
        side = 'far' if self.value > 1.0 else 'little'
        percent = 100.0 * abs(self.value - 1.0)
        return f'{percent:.0f} % too {side} (sigma {100.0 * self.sigma:.0f} %)'


def _spans() -> deque[float]:
    return deque(maxlen=_MOST_SPANS)


@dataclass(eq=False)
class OdometryScale:
    """Compares turns and distances of the odometry with those of scan matching.

    The calibration of the odometry takes a large error for wheel slip. The median of the ratios of
    many spans does not, and single slips do not change it.
    """

    _ratios: dict[str, deque[float]] = field(
        default_factory=lambda: {'turn': _spans(), 'distance': _spans(), 'sideways': _spans()}
    )
    _begin: tuple[Array, Array] | None = None

    def reset_span(self) -> None:
        """Discard the current span: a pose is unknown, or is not due to matching."""
        self._begin = None

    def forget(self) -> None:
        """Begin again: the odometry of the scans so far was that of another time."""
        self.reset_span()
        for ratios in self._ratios.values():
            ratios.clear()

    def add(self, T_map_base: Array, information: Array, T_odom_base: Array) -> None:
        """Add a matched pose (3,), the information (3, 3) of its scan, and the odometry (3,)."""
        if se2.variances(information[:2, :2])[0] < _MAX_SIGMA_M**-2.0:
            self.reset_span()
            return
        if self._begin is None:
            self._begin = (T_map_base, T_odom_base)
            return
        x, y, turn = found = se2.between(self._begin[0], T_map_base)
        if math.hypot(x, y) < _SPAN_M and abs(turn) < _SPAN_RAD:
            return
        self._add_span(found, se2.between(self._begin[1], T_odom_base))
        self._begin = (T_map_base, T_odom_base)

    @property
    def values(self) -> dict[str, Ratio]:
        """The ratios that are known: of turn, distance and sideways motion."""
        return {
            kind: _median(ratios)
            for kind, ratios in self._ratios.items()
            if len(ratios) >= _LEAST_SPANS
        }

    @property
    def warning(self) -> str:
        """Which motions of the odometry are certainly and considerably wrong; '' for none."""
        wrong = {kind: ratio for kind, ratio in self.values.items() if self._is_wrong(ratio)}
        parts = [f'{_VERBS[kind]} {ratio.text}' for kind, ratio in wrong.items()]
        return f'odometry {" and ".join(parts)}: {_advice(wrong)}' if wrong else ''

    def _add_span(self, found: Array, odometry: Array) -> None:
        x, y, turn = found.tolist()
        if _TURN_RAD[0] <= abs(turn) <= _TURN_RAD[1]:
            self._ratios['turn'].append(float(odometry[2]) / turn)
        length = math.hypot(x, y)
        if length < _SPAN_M:
            return
        # In the direction of the motion, which a wrong turn of the odometry bends.
        bent = 0.5 * (turn - float(odometry[2]))
        moved = rotation(bent)[:2, :2] @ odometry[:2]
        kind = 'distance' if abs(x) >= abs(y) else 'sideways'
        self._ratios[kind].append(float(moved @ found[:2]) / length**2)

    def _is_wrong(self, ratio: Ratio) -> bool:
        least = abs(ratio.value - 1.0) - BOUND_SIGMAS * ratio.sigma
        return _POSSIBLE[0] < ratio.value < _POSSIBLE[1] and least > _CONSIDERABLE


_VERBS = {'turn': 'turns', 'distance': 'moves', 'sideways': 'moves sideways'}


def _median(ratios: Collection[float]) -> Ratio:
    """Median of ratios, with its standard deviation where they are normally distributed."""
    value = median(ratios)
    spread = 1.4826 * median(abs(ratio - value) for ratio in ratios)
    return Ratio(value, math.hypot(1.2533 * spread / math.sqrt(len(ratios)), _COMMON))


def _advice(wrong: dict[str, Ratio]) -> str:
    """Values for the driver of a base with two wheels, and of one with more."""
    return 'set in its driver ' + ', '.join(_factors(wrong))


def _factors(wrong: dict[str, Ratio]) -> Iterator[str]:
    """What to multiply. A turn is the difference of two distances by the wheel separation."""
    distance = wrong['distance'].value if 'distance' in wrong else 1.0
    turn = wrong['turn'].value if 'turn' in wrong else 1.0
    if 'distance' in wrong:
        yield f'the wheel radius to {1.0 / distance:.2f} times its value'
    if turn != distance:
        yield f'the wheel separation to {turn / distance:.2f} times its value'
    if 'sideways' in wrong:
        yield f'the scale of y to {1.0 / wrong["sideways"].value:.2f} times its value'
