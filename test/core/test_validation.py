"""Names of files in error messages."""

import pytest

from thinmap_ros.core.validation import quoted_name


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
