"""How likely an end node is to stay where it is once all is explored: the equations, one by one.

Source: exploration paper section 3.2, equations (1) to (10).
"""

import numpy as np

from thinmap_ros.core.se2 import Array, wrap

NEAR_M = 0.5
_SUREST = 1.0 - 1e-6


def nearest_distance(distances_m: Array) -> float:
    """r: smallest of the distances (t,) between end node and robot so far, never less than 0.5 m.

    Source: exploration paper equation (2).
    """
    return max(NEAR_M, float(np.min(distances_m)))


def distance_index(r: float) -> float:
    """D: 1.0 at r = 0.5 m, 0.5 at 4.5 m, less farther off, where a look speaks against the node.

    Source: exploration paper equations (1) and (2).
    """
    return 4.0 / (max(r, NEAR_M) + 3.5)


def angle_difference(bearings_rad: Array) -> float:
    """a_max, degrees: largest difference between any two bearings (t,) under which a node was seen.

    Bearings are those of the vector from robot to node in the global frame; differences are taken
    the shorter way round, so none is above 180 degrees.
    Source: exploration paper equation (3).
    """
    return float(np.degrees(np.abs(wrap(bearings_rad[:, None] - bearings_rad[None, :])).max()))


def angle_index(span_deg: float) -> float:
    """A: 0 where all looks came from one side, 1 from 90 degrees on.

    Source: exploration paper equation (4).
    """
    return min(span_deg / 90.0, 1.0)


def reliability(r: float, span_deg: float) -> float:
    """R: the better of the distance index at r (m) and the angle index of a span (degrees).

    Source: exploration paper equation (5).
    """
    return max(distance_index(r), angle_index(span_deg))


def bayes_update(p: float, reliability: float) -> float:
    """Position probability after a look of a reliability R: R p / (R p + (1 - R)(1 - p)).

    R = p(X | reliable) and 1 - R = p(X | unreliable). The result stays a millionth away from 0 and
    1, because nothing could ever change a certainty again.
    Source: exploration paper equations (6) to (10).
    """
    for_it = reliability * p
    against = (1.0 - reliability) * (1.0 - p)
    posterior = for_it / (for_it + against) if for_it + against > 0.0 else p
    return min(max(posterior, 1.0 - _SUREST), _SUREST)
