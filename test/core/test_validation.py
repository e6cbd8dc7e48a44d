"""Names of files in error messages, and angles of scans."""

import math

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError, angle_warning, quoted_name, require_angles

DEGREE = math.radians(1.0)


@pytest.mark.parametrize(
    ('name', 'expected'),
    [
        ('a' * 80, 'a' * 80),
        ('a' * 81, 'a' * 80 + '...'),
        ('two\nlines', r'two\nlines'),
    ],
)
def test_a_name_is_shortened_beyond_80_characters_and_shown_in_one_line(name, expected):
    assert quoted_name(name) == expected


@pytest.mark.parametrize(
    ('first', 'last', 'step', 'count'),
    [
        pytest.param(-math.pi, math.pi - DEGREE, DEGREE, 360, id='as sensor_msgs says'),
        pytest.param(-math.pi, math.pi, DEGREE, 360, id='the end of the last interval'),
        pytest.param(-math.pi, math.pi, DEGREE, 361, id='the first beam again'),
        pytest.param(0.0, 2.0 * math.pi, DEGREE, 360, id='from 0'),
        pytest.param(math.pi, -math.pi + DEGREE, -DEGREE, 360, id='clockwise'),
        pytest.param(-math.pi, math.pi - DEGREE, 0.0175, 360, id='increment rounded'),
        pytest.param(0.0, 6.28319, 0.0175, 360, id='a driver of the LDS-01'),
        pytest.param(-3.14159, 3.14159, 0.00436, 1440, id='four times as many beams, rounded'),
        pytest.param(-math.pi / 2.0, math.pi / 2.0, DEGREE, 181, id='half a turn'),
        pytest.param(-0.5, 0.5, 1.0, 2, id='two beams'),
        pytest.param(0.3, 7.0, 0.0, 1, id='a single beam has no increment'),
    ],
)
def test_angles_that_fit_the_beams_are_no_warning(first, last, step, count):
    angles = np.array([first, last, step], dtype=np.float32).tolist()
    assert angle_warning(*angles, count) == ''


@pytest.mark.parametrize(
    ('first', 'last', 'step', 'count', 'fits'),
    [
        (-math.pi, math.pi - DEGREE, DEGREE, 300, 'fits 360 beams, 300 came'),
        (-math.pi, math.pi - DEGREE, 2.0 * DEGREE, 360, 'fits 180 beams, 360 came'),
        (-math.pi, math.pi - DEGREE, -DEGREE, 360, 'fits -358 beams, 360 came'),
        (-math.pi, math.pi - DEGREE, 1.0, 13, 'fits 7 beams, 13 came'),
        (-math.pi, math.nan, DEGREE, 360, 'fits no number of beams, 360 came'),
        (0.0, 0.0, DEGREE, 360, 'fits 1 beams, 360 came'),
    ],
)
def test_angles_that_do_not_fit_the_beams_are_a_warning_with_both_numbers(
    first, last, step, count, fits
):
    assert fits in angle_warning(first, last, step, count)


def test_angles_in_degrees_are_an_error_that_says_so():
    require_angles(-math.pi, DEGREE, 360)
    with pytest.raises(InputError, match=r'360 beams from -180 to 179 rad: .*in degrees'):
        require_angles(-180.0, 1.0, 360)
    with pytest.raises(InputError, match='in degrees'):
        require_angles(-math.pi, 1.0, 360)
