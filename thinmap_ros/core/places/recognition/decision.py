"""Whether two pieces of map are joined: each of the two must be sure by itself."""

import math
from dataclasses import dataclass

from thinmap_ros.core.places.recognition.piece import MapPiece
from thinmap_ros.core.places.recognition.recognition import (
    Placement,
    Recognition,
    log_odds_back,
)

JOIN_ODDS = 100_000.0


@dataclass(frozen=True, eq=False)
class Decision:
    """The most likely place of a piece in a map, or None; whether it is accepted.

    log_odds: of the place by the views of the piece, or by those of the map in the piece if these
    are less; views: how many views of the piece were looked for.
    """

    is_joined: bool
    placement: Placement | None
    log_odds: float
    views: int


def decide(
    recognition: Recognition, query: MapPiece, known: MapPiece, join_odds: float = JOIN_ODDS
) -> Decision:
    """Decide whether a piece lies in a map.

    recognition: of the views of the piece in the map so far; query: the piece as it is now.
    """
    placement = recognition.placement()
    views = recognition.views
    if placement is None:
        return Decision(False, None, -math.inf, len(views))
    log_odds = placement.log_odds
    if log_odds > math.log(join_odds):
        back = log_odds_back(query, known, views, placement.hypothesis)
        log_odds = min(log_odds, back)
    return Decision(log_odds > math.log(join_odds), placement, log_odds, len(views))


def recognize(
    query: MapPiece, known: MapPiece, join_odds: float = JOIN_ODDS, seed: int = 0
) -> Decision:
    """Look for all views of a piece in a map, and decide by all of them."""
    recognition = Recognition(known, seed)
    for view in query.views:
        recognition.add(view, query.landmarks.around(view))
    return decide(recognition, query, known, join_odds)
