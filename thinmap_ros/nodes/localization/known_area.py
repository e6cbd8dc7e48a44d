"""Where an initial pose may lie: in the map, or near it."""

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import AnyLocalizer

# A robot farther away sees nothing of the map: the range of long lasers.
_MARGIN_M = 30.0


def require_near_map(T_map_base: Array, localizer: AnyLocalizer) -> None:
    """Raise InputError unless a pose (3,) is near the map of a localizer, if that has one."""
    places = localizer.known_places()
    if not len(places):
        return
    place = T_map_base[:2]
    away = place - np.clip(place, places.min(axis=0), places.max(axis=0))
    away_m = float(np.hypot(*away))
    if away_m > _MARGIN_M:
        x, y = place.tolist()
        raise InputError(
            f'pose at {x:.1f}, {y:.1f} m, {away_m:.1f} m from the map: '
            f'expected a place in the map or within {_MARGIN_M:.0f} m of it'
        )
