"""The configuration of each localizer, chosen by `slam`, has its own parameters and no others."""

import pytest

from thinmap_ros.core.config import parameters_of
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer
from thinmap_ros.core.errors import ConfigError
from thinmap_ros.core.slam.localizer import (
    Localizer,
    config_class,
    config_with,
    default_config,
    localizer_class,
    parameters_elsewhere,
)
from thinmap_ros.core.slam.track import LocalizerConfig

FILTERS = ('association.', 'features.')
MATCHING = (
    'lost_threshold',
    'map_tag',
    'odometry.noise_window',
    'matching.',
    'local_map.',
    'keyframes.',
    'loop_closure.',
)


@pytest.mark.parametrize(
    ('slam', 'config', 'localizer'),
    [
        ('scan_matching', LocalizerConfig, Localizer),
        ('ekf_ti', EkfConfig, EkfLocalizer),
        ('ekf_full', EkfConfig, EkfLocalizer),
    ],
)
def test_slam_chooses_configuration_and_localizer(slam: str, config: type, localizer: type) -> None:
    chosen = default_config(slam)
    assert type(chosen) is config_class(slam) is config
    assert chosen.slam == slam
    made = localizer_class(chosen)(chosen)
    assert type(made) is localizer
    assert made.config is chosen


@pytest.mark.parametrize(
    ('slam', 'own', 'others', 'meant'),
    [
        ('scan_matching', MATCHING, FILTERS, 'slam: ekf_ti or ekf_full'),
        ('ekf_ti', FILTERS, MATCHING, 'slam: scan_matching'),
        ('ekf_full', FILTERS, MATCHING, 'slam: scan_matching'),
    ],
)
def test_a_localizer_has_no_parameter_of_another(
    slam: str, own: tuple[str, ...], others: tuple[str, ...], meant: str
) -> None:
    names = [name for name, _, _ in parameters_of(default_config(slam))]
    assert all(any(name.startswith(group) for name in names) for group in own)
    assert not any(name.startswith(others) for name in names)
    elsewhere = parameters_elsewhere(slam)
    assert all(any(name.startswith(group) for name in elsewhere) for group in others)
    assert all(name.startswith(others) for name in elsewhere)
    assert set(elsewhere.values()) == {meant}


@pytest.mark.parametrize('make', [config_class, default_config, parameters_elsewhere])
def test_another_slam_is_an_error_that_lists_them_all(make) -> None:
    with pytest.raises(ConfigError, match=r"slam = 'magic': expected one of scan_.*, ekf_full$"):
        make('magic')


def test_a_configuration_is_for_its_own_localizer() -> None:
    with pytest.raises(ConfigError, match="'ekf_ti': LocalizerConfig expected scan_matching"):
        LocalizerConfig(slam='ekf_ti')
    with pytest.raises(ConfigError, match='EkfConfig expected ekf_ti or ekf_full'):
        EkfConfig(slam='scan_matching')


def test_values_by_name_choose_the_localizer_too() -> None:
    config = config_with({'slam': 'ekf_full', 'association.gate': 4.0})
    assert isinstance(config, EkfConfig)
    assert config.association.gate == 4.0
    assert config_with({'lost_threshold': 3.0}) == LocalizerConfig(lost_threshold=3.0)
    with pytest.raises(ConfigError, match='no parameter lost_threshold'):
        config_with({'slam': 'ekf_ti', 'lost_threshold': 3.0})
