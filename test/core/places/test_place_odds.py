"""Log odds of a place: what a look is worth, how many places there are, and the prior."""

import math

import numpy as np
import pytest

from thinmap_ros.core.places.place_odds import (
    IN_THIS_MAP,
    MAX_LOG_RATIO,
    MAY_BE_ELSEWHERE,
    MIN_KNOWN,
    Shares,
    limited,
    log_odds_of_any,
    log_odds_of_first,
    log_ratios,
)

HERE = Shares(0.8, 0.12)
ELSEWHERE = Shares(0.3, 0.12)


def ratio(found, known=1.0, elsewhere=ELSEWHERE):
    return float(log_ratios(found, known, HERE, elsewhere))


def test_a_look_is_worth_the_more_the_less_is_found_elsewhere():
    assert ratio(0.8) > ratio(0.6) > 0.0 > ratio(0.4)
    assert ratio(0.8, elsewhere=Shares(0.75, 0.15)) < 0.5
    assert ratio(0.95) > ratio(0.8)  # even fewer other places show so much


def test_of_what_the_map_tells_little_a_look_is_worth_little():
    assert ratio(0.8, 0.5) == pytest.approx(0.5 * ratio(0.8))
    assert ratio(0.8, MIN_KNOWN - 0.01) == 0.0


def test_one_look_tells_no_more_than_is_allowed():
    assert limited(np.array([99.0, 1.0, -99.0])).tolist() == [MAX_LOG_RATIO, 1.0, -MAX_LOG_RATIO]


def test_shares_are_no_surer_than_what_was_not_measured():
    assert Shares.of([0.5, 0.5], 0.1) == Shares(0.5, 0.1)
    assert Shares.of([0.2, 0.8], 0.1) == pytest.approx((0.5, 0.3))


def test_the_odds_are_those_of_bayes_rule():
    evidence = np.array([9.0, 8.0, 3.0])
    alternatives = math.log(2500.0)
    likelihoods = np.exp(evidence - alternatives)
    for elsewhere in (MAY_BE_ELSEWHERE, IN_THIS_MAP):
        none = math.exp(elsewhere)
        assert log_odds_of_first(evidence, alternatives, elsewhere) == pytest.approx(
            math.log(likelihoods[0] / (likelihoods[1:].sum() + none))
        )
        assert log_odds_of_any(evidence, alternatives, elsewhere) == pytest.approx(
            math.log(likelihoods.sum() / none)
        )


def test_that_it_is_in_the_map_makes_one_place_as_much_surer():
    evidence = np.array([12.0])
    apart, asked = (
        log_odds_of_first(evidence, 10.0, prior) for prior in (MAY_BE_ELSEWHERE, IN_THIS_MAP)
    )
    assert asked - apart == pytest.approx(MAY_BE_ELSEWHERE - IN_THIS_MAP)


def test_two_places_alike_are_even_whatever_the_prior():
    evidence = np.array([60.0, 60.0])
    assert log_odds_of_first(evidence, 10.0, IN_THIS_MAP) == pytest.approx(0.0, abs=1e-6)
    assert log_odds_of_any(evidence, 10.0, IN_THIS_MAP) > 40.0
