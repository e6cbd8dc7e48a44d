"""What explorations do not see: free cells beyond frontiers."""

import pytest

from benchmarks.exploration.missing_area import Missed, fringe
from thinmap_ros.core.exploration.belief import MissingArea


def test_a_fringe_is_what_lies_beyond_most_frontiers():
    found = [Missed(n // 2, n, MissingArea(1.0, 2.0), 0.01) for n in (80, 120, 200, 240, 300)]
    found[3] = found[3]._replace(cells=found[3].cells + 300)  # a part of a room
    assert fringe(found) == pytest.approx(0.5)
