"""Inlier ratio at the true pose in a map.

Near 1 with smooth walls, lower with small objects.
"""

import numpy as np
import pytest
from support.small_floor import OFFICE, START, drive, map_of

from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.core.places.global_localizer import usual_share
from thinmap_ros.core.places.likelihood import Judge
from thinmap_ros.core.places.place_database import GlobalLocalizationConfig, Places, calibrate

CONFIG = GlobalLocalizationConfig()


def share_in(cells):
    places = Places.of(*map_of(cells), CONFIG)
    scan, _, _ = next(drive(OFFICE, START, []))
    judge = Judge(places, CONFIG, calibrate(places, scan, CONFIG, np.random.default_rng(1)))
    return usual_share(places, judge, scan, CONFIG, np.random.default_rng(2))


def test_smooth_walls_explain_nearly_all_and_a_floor_full_of_small_things_less():
    littered = OFFICE.copy()
    inner = littered[2:-2, 2:-2]
    inner[np.random.default_rng(3).random(inner.shape) < 0.04] = 100
    clean = share_in(OFFICE)
    rough = share_in(littered)
    assert 0.97 < clean <= 1.0
    assert 0.7 <= rough < clean - 0.02


def test_beams_on_which_the_map_is_silent_are_not_counted():
    explored = OFFICE.copy()
    explored[:, 45:] = UNKNOWN
    assert 0.85 < share_in(explored) <= 1.0


@pytest.mark.parametrize(('laser_m', 'beam_m'), [(0.005, 0.02), (0.015, 0.02), (0.03, 0.03)])
def test_a_beam_is_compared_with_no_less_noise_than_walls_have(laser_m, beam_m):
    assert GlobalLocalizationConfig(laser_range_noise_m=laser_m).beam_noise_m == beam_m
    assert GlobalLocalizationConfig().beam_noise_m == 0.02
