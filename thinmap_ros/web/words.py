"""The state of the robot in words."""

import math
from typing import Any

from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID

_STATES = ('TRACKING', 'LOST', 'BLIND', 'NO MAP', 'MISALIGNED', 'MAPPING APART')
_DETAILS = (
    'the laser confirms the pose',
    'the place of the robot in the map is unknown',
    'the laser does not confirm the pose: odometry alone',
    'no map to match: odometry alone',
    'the laser is turned on the robot: its scans are not mapped',
    'lost: a piece of its own is mapped',
)
_MAPPING_APART = 5
_DOING = ('idle', 'exploring', 'returning', 'finished')


def slam_words(message: Any) -> dict[str, Any]:
    """State of a thinmap_msgs/SlamStatus, and why."""
    state = min(int(message.state), len(_STATES) - 1)
    detail = _DETAILS[state]
    if state == _MAPPING_APART:
        odds = float(message.join_odds)
        place = f'best place at odds of {odds:.3g} to 1' if odds > 0.0 else 'no place is found yet'
        detail = f'{detail}, {message.apart_m:.1f} m so far; {place}'
    if message.is_contradicted:
        detail += '; scans contradict the map'
    return {'state': _STATES[state], 'detail': detail, 'is_well': state == 0}


def exploration_words(message: Any) -> dict[str, Any]:
    """Progress of a thinmap_msgs/ExplorationStatus."""
    doing = _DOING[min(int(message.state), len(_DOING) - 1)]
    words = [f'{message.distance_m:.1f} m']
    if message.has_target:
        place = message.target_position
        is_frontier = message.target_id >= FIRST_FRONTIER_ID
        what = 'a frontier' if is_frontier else f'end node {message.target_id}'
        words.append(f'to {what} at {place.x:.1f}, {place.y:.1f}')
    if message.state != 0:
        words += _missing(message)
    if message.reason:
        words.append(message.reason)
    return {
        'state': doing,
        'detail': ', '.join(words),
        'coverage': _finite(message.coverage_estimate),
        'distance': _finite(message.distance_m),
    }


def _missing(message: Any) -> list[str]:
    missing = float(message.missing_area_m2)
    bound = float(message.missing_area_bound_m2)
    if not missing >= 0.0:
        return []
    return [f'{missing:.0f} m2 missing, with 95 % no more than {bound:.0f} m2']


def _finite(number: float) -> float:
    return round(float(number), 4) if math.isfinite(number) else 0.0
