"""Parameters that the chosen localizer does not use."""

import pytest

from thinmap_ros.core.config import with_values
from thinmap_ros.core.slam.localizer_config import LocalizerConfig
from thinmap_ros.core.slam.localizers import without_effect

VALUES = {
    'association.gate': 4.0,
    'features.max_misses': 3,
    'matching.noise_m': 0.08,
    'loop_closure.search_radius_m': 3.0,
    'lines.min_points': 9,
    'initial_x_m': 1.0,
}


@pytest.mark.parametrize(
    ('slam', 'unused'),
    [
        ('scan_matching', ['association.gate', 'features.max_misses']),
        ('ekf_ti', ['loop_closure.search_radius_m', 'matching.noise_m']),
        ('ekf_full', ['loop_closure.search_radius_m', 'matching.noise_m']),
    ],
)
def test_what_another_localizer_uses_has_no_effect(slam: str, unused: list[str]) -> None:
    config = LocalizerConfig(slam=slam)
    assert without_effect(config) == []
    assert sorted(without_effect(with_values(config, VALUES))) == unused
