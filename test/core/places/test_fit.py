"""Inlier ratio at the true pose in a map.

Near 1 with smooth walls, lower with small objects.
"""

import numpy as np
import pytest
from support.small_floor import OFFICE, START, drive, map_of

from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.core.places.global_localizer import measured_looks
from thinmap_ros.core.places.likelihood import Judge
from thinmap_ros.core.places.place_database import GlobalLocalizationConfig, Places, calibrate
from thinmap_ros.core.places.place_odds import MAX_LOG_RATIO, MissingShares

CONFIG = GlobalLocalizationConfig()


def model_in(cells):
    places = Places.of(*map_of(cells), CONFIG)
    scan, _, _ = next(drive(OFFICE, START, []))
    judge = Judge(places, CONFIG, calibrate(places, scan, CONFIG, np.random.default_rng(1)))
    return measured_looks(places, judge, scan, CONFIG, np.random.default_rng(2))


def share_in(cells):
    return 1.0 - model_in(cells).right


def test_smooth_walls_explain_nearly_all_and_a_floor_full_of_small_things_less():
    littered = OFFICE.copy()
    inner = littered[2:-2, 2:-2]
    inner[np.random.default_rng(3).random(inner.shape) < 0.04] = 100
    clean = share_in(OFFICE)
    rough = share_in(littered)
    assert 0.97 < clean <= 1.0
    assert 0.7 <= rough < clean - 0.02


def worth(model, missing, known=1.0):
    return float(model.log_ratios(np.array([1.0 - missing]), np.array([known]))[0])


def test_what_a_look_is_worth_falls_with_what_it_leaves_unexplained():
    smooth = MissingShares(0.01, 0.02)
    assert worth(smooth, 0.0) == pytest.approx(np.log(2.0))
    assert worth(smooth, 0.0) > worth(smooth, 0.01) > 0.0 > worth(smooth, 0.02)
    assert worth(smooth, 1.0) == -MAX_LOG_RATIO
    assert worth(smooth, 0.0, 0.7) == pytest.approx(0.7 * np.log(2.0))
    assert worth(smooth, 0.0, 0.5) == 0.0  # it may as well have left the map


def test_bare_walls_tell_less_at_a_look_than_a_map_in_which_there_are_things():
    bare = OFFICE.copy()
    bare[1:-1, 1:-1] = 0
    assert worth(model_in(OFFICE), 0.0) > worth(model_in(bare), 0.0) > 0.0


def test_beams_on_which_the_map_is_silent_are_not_counted():
    explored = OFFICE.copy()
    explored[:, 45:] = UNKNOWN
    assert 0.85 < share_in(explored) <= 1.0


@pytest.mark.parametrize(('laser_m', 'beam_m'), [(0.005, 0.02), (0.015, 0.02), (0.03, 0.03)])
def test_a_beam_is_compared_with_no_less_noise_than_walls_have(laser_m, beam_m):
    assert GlobalLocalizationConfig(laser_range_noise_m=laser_m).beam_noise_m == beam_m
    assert GlobalLocalizationConfig().beam_noise_m == 0.02
