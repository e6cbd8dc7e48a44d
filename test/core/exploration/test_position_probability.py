"""Equations (1) to (10) of the exploration paper, against results by hand, and their meaning."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.exploration.paper import (
    PaperConfig,
    PaperEndNode,
    angle_index,
    bayes_update,
    distance_index,
    reliability,
)

shares = st.floats(0.05, 0.95)
EACH_VIEW = PaperConfig(observation_distance_m=0.0, observation_angle_deg=0.0)


def seen_from(views):
    """End node after views from distances, m, and bearings, rad."""
    node = PaperEndNode(1, (0.0, 0.0), (0.0, 0.0))
    for distance, bearing in views:
        laser = np.array([-distance * math.cos(bearing), -distance * math.sin(bearing)])
        node.add_view(laser, EACH_VIEW)
    return node


@pytest.mark.parametrize(
    ('r', 'index'), [(0.5, 1.0), (4.5, 0.5), (0.0, 1.0), (8.0, 4.0 / 11.5), (2.5, 4.0 / 6.0)]
)
def test_distance_index_is_equation_1(r, index):
    assert distance_index(r) == pytest.approx(index)


def test_far_looks_speak_against_a_node_since_nothing_clips_the_index():
    # The paper's Fig. 10 shows 0.44 after one observation: D = 0.44 at 5.6 m.
    assert bayes_update(0.5, reliability(4.0 / 0.44 - 3.5, 0.0)) == pytest.approx(0.44)


@given(st.lists(st.floats(0.0, 30.0), min_size=1))
def test_nearest_distance_is_the_smallest_so_far_and_never_below_half_a_metre(distances):
    node = seen_from([(distance, 0.0) for distance in [*distances, 100.0]])
    assert node.distance_index == pytest.approx(distance_index(max(0.5, min(distances))))


@given(st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=8))
def test_angle_difference_is_the_largest_of_all_pairs(bearings):
    def between(a, b):
        return abs(math.degrees(math.atan2(math.sin(a - b), math.cos(a - b))))

    largest = max(between(a, b) for a in bearings for b in bearings)
    found = seen_from([(2.0, bearing) for bearing in bearings]).angle_span_deg
    assert found == pytest.approx(largest, abs=1e-6)


def test_angle_difference_goes_the_shorter_way_round():
    across = seen_from([(2.0, math.radians(degrees)) for degrees in (170.0, -170.0)])
    assert across.angle_span_deg == pytest.approx(20.0)
    spread = seen_from([(2.0, math.radians(degrees)) for degrees in (10.0, 40.0, 80.0)])
    assert spread.angle_span_deg == pytest.approx(70.0)


@pytest.mark.parametrize(('span', 'index'), [(0.0, 0.0), (45.0, 0.5), (90.0, 1.0), (180.0, 1.0)])
def test_angle_index_is_equation_4(span, index):
    assert angle_index(span) == pytest.approx(index)


@given(st.floats(0.0, 30.0), st.floats(0.0, 180.0))
def test_reliability_is_the_better_of_both(r, span):
    assert reliability(r, span) == max(distance_index(r), angle_index(span))
    assert 0.0 < reliability(r, span) <= 1.0


@given(shares, shares)
def test_update_is_bayes_rule(p, value):
    assert bayes_update(p, value) == pytest.approx(
        value * p / (value * p + (1.0 - value) * (1.0 - p)), abs=1e-6
    )


@given(shares, st.lists(shares, max_size=3))
def test_the_order_of_looks_does_not_matter(p, values):
    one = p
    other = p
    for value in values:
        one = bayes_update(one, value)
    for value in reversed(values):
        other = bayes_update(other, value)
    assert one == pytest.approx(other, abs=1e-3)


@given(st.floats(0.0, 1.0), st.lists(st.floats(0.0, 1.0), max_size=50))
def test_probability_never_becomes_a_certainty(p, values):
    for value in values:
        p = bayes_update(p, value)
        assert 0.0 < p < 1.0


def test_even_reliability_says_nothing_and_more_reliable_looks_raise_more():
    assert bayes_update(0.7, 0.5) == pytest.approx(0.7)
    assert bayes_update(0.7, 0.4) < 0.7 < bayes_update(0.7, 0.6) < bayes_update(0.7, 0.9)
