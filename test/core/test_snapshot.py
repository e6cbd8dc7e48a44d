"""Saved states: what a field without bounds takes."""

import math

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.snapshot import Field, validate

FIELDS = {'values': Field(np.float64, ('n',))}


def test_a_field_without_bounds_takes_every_number():
    values = np.array([-math.inf, -1e300, 0.0, 1e300, math.inf])
    checked = validate({'values': values}, FIELDS, 'state')
    np.testing.assert_array_equal(checked['values'], values)


def test_a_field_without_bounds_refuses_nan():
    with pytest.raises(InputError, match=r'values\[1\]: nan'):
        validate({'values': np.array([0.0, math.nan])}, FIELDS, 'state')
