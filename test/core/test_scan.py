"""Classification of beams."""

import math

import numpy as np
import pytest

from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.scan import LaserConfig, Scan


def scan_of(ranges, **changes):
    fields = {
        'angle_min_rad': -math.pi / 2,
        'angle_increment_rad': 0.1,
        'range_min_m': 0.1,
        'range_max_m': 8.0,
    }
    return Scan.create(5, ranges, **(fields | changes))


def test_only_ranges_within_the_limits_are_hits():
    scan = scan_of([np.nan, np.inf, -np.inf, 0.0, -1.0, 0.05, 0.2, 7.9, 8.0, 81.83])
    np.testing.assert_array_equal(np.flatnonzero(scan.hit), [6, 7])
    np.testing.assert_array_equal(np.flatnonzero(scan.no_return), [1, 8, 9])


def test_a_zero_range_is_no_hit_even_where_the_sensor_claims_to_measure_it():
    assert not scan_of([0.0], range_min_m=0.0).hit.any()


def test_points_follow_the_mount_of_a_clockwise_laser():
    scan = scan_of(
        [2.0, 3.0],
        angle_min_rad=math.pi / 2,
        angle_increment_rad=-math.pi / 2,
        T_base_laser=np.array([1, 0, 0]),
    )
    np.testing.assert_allclose(scan.points_base(), [[1, 2], [4, 0]], atol=1e-6)


def test_values_are_those_of_a_laserscan_message():
    scan = scan_of([1.234567891], angle_increment_rad=math.radians(1))
    assert scan.ranges_m[0] == float(np.float32(1.234567891))
    assert scan.angle_increment_rad == float(np.float32(math.radians(1)))


def test_an_empty_scan_has_no_points():
    assert scan_of([]).points_base().shape == (0, 2)


@pytest.mark.parametrize(
    'changes',
    [
        {'angle_min_rad': math.nan},
        {'range_max_m': 0.05},
        {'range_min_m': -1.0},
        {'angle_increment_rad': math.inf},
        {'angle_increment_rad': 0.0},
    ],
)
def test_geometry_that_is_none_is_refused(changes):
    with pytest.raises(InputError, match='expected'):
        scan_of([1.0, 1.0], **changes)


def one_range(value, **options):
    return Scan.create(0, np.full(20, value), -1.0, 0.1, 0.1, 8.0, **options)


@pytest.mark.parametrize(
    'value, name',
    [
        (3.0, 'hit'),
        (0.1, 'hit'),
        (np.inf, 'no_return'),
        (8.0, 'no_return'),
        (81.83, 'no_return'),
        (-np.inf, 'below_range_min'),
        (np.nan, ''),
        (0.0, ''),
        (-1.0, ''),
        (0.05, ''),
    ],
)
def test_each_range_is_a_hit_or_free_or_invalid(value, name):
    scan = one_range(value)
    said = [key for key in ('hit', 'no_return', 'below_range_min') if getattr(scan, key).all()]
    assert said == ([name] if name else [])
    assert scan.valid.all() == bool(name)
    assert scan.is_blind == (not name)


def test_zero_may_be_configured_as_no_return():
    """The LDS of the TurtleBot 3; a range of zero still frees no cells."""
    scan = one_range(0.0, laser=LaserConfig(zero_is_no_return=True))
    assert scan.valid.all()
    assert not scan.is_blind
    assert not scan.no_return.any()
    assert one_range(np.nan, laser=LaserConfig(zero_is_no_return=True)).is_blind


@pytest.mark.parametrize('valid, blind', [(0, True), (9, True), (10, False), (50, False)])
def test_fewer_than_a_tenth_of_the_beams_is_blind(valid, blind):
    ranges = np.full(100, np.nan)
    ranges[:valid] = np.inf
    assert Scan.create(0, ranges, -1.0, 0.01, 0.1, 8.0).is_blind == blind


@pytest.mark.parametrize(
    ('text', 'left_out'),
    [
        ('', []),
        ('-180 -135, 135 180', [-180, -135, 135]),
        ('135 -135', [-180, -135, 135]),
        ('135 225', [-180, -135, 135]),
        ('-180 180', [-180, -135, -90, -45, 0, 45, 90, 135]),
        (' 10 20 ,, -46 -44 ', [-45]),
    ],
)
def test_beams_into_the_sectors_of_the_body_are_invalid(text, left_out):
    scan = Scan.create(
        0, np.ones(8), -math.pi, math.pi / 4, 0.1, 8.0, laser=LaserConfig(body_sectors=text)
    )
    degrees = np.rint(np.degrees(scan.angles_rad))
    np.testing.assert_array_equal(np.isnan(scan.ranges_m), np.isin(degrees, left_out))


@pytest.mark.parametrize('text', ['12', '1 2 3', 'a b', 'nan 3', '10 400', '10, 20'])
def test_what_is_no_sector_is_named(text):
    with pytest.raises(ConfigError, match=f"body_sectors = '{text}': expected pairs of bearings"):
        LaserConfig(body_sectors=text)


def test_ranges_below_the_least_one_are_invalid():
    ranges = [-np.inf, 0.0, 0.2, 0.31, np.inf]
    laser = LaserConfig(min_range_m=0.3, zero_is_no_return=True)
    scan = Scan.create(0, ranges, 0.0, 0.1, 0.1, 8.0, laser=laser)
    assert scan.below_range_min[0] and scan.hit[3] and scan.no_return[4]
    np.testing.assert_array_equal(scan.valid, [True, True, False, True, True])
