"""Tables of place recognition: joined or not, with which error, after which path, at which cost."""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.places.pieces import (
    LOGS,
    RecordedPiece,
    is_shared,
    relative_errors,
    rigid_errors,
    with_shared_ground,
    without_shared_ground,
)
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.places.piece import MapPiece, drawn_scans
from thinmap_ros.core.places.recognition import JoinDecision, Recognition, decide, recognize
from thinmap_ros.core.slam.joining.join import join
from thinmap_ros.core.slam.joining.pieces import SlamPiece
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap
from thinmap_ros.evaluation.outcome import Table
from thinmap_ros.sim.laser import LaserScannerConfig

_NEAREST_FALSE = 8  # pairs that are listed
Pieces = Sequence[RecordedPiece]


def shared(pieces: Pieces) -> Table:
    """Pairs that share ground, view by view until they are joined, then with all views."""
    columns = (
        'map <- query',
        'views until joined',
        'of',
        'path m',
        'log odds then',
        'with all views',
        'error m: least',
        'median, rigid',
        'ms a view',
    )
    maps = _maps(pieces)
    rows = [_watched(known, query, maps) for known, query in with_shared_ground(pieces)]
    return Table('shared', columns, rows, timed=True)


def _watched(known: RecordedPiece, query: RecordedPiece, maps: dict[str, MapPiece]) -> list[Any]:
    """A row: views are added one by one, as on line, with a decision each until both are joined."""
    there = maps[known.name]
    own = maps[query.name]
    recognition = Recognition(there)
    joined: JoinDecision | None = None
    began = time.process_time()
    for view in own.views:
        recognition.add(view, own.landmarks.around(view))
        if joined is None:
            decision = decide(recognition, own, there)
            joined = decision if decision.is_joined else None
    ms = 1e3 * (time.process_time() - began) / max(len(own.views), 1)
    last = decide(recognition, own, there).log_odds
    name = f'{known.name} <- {query.name}'
    if joined is None or joined.placement is None:
        return [name, None, len(own.views), None, None, last, None, None, ms]
    errors = rigid_errors(known, query, joined.placement.T_map_piece)
    row = [
        name,
        joined.views,
        len(own.views),
        own.views[joined.views - 1].path_m,
        joined.log_odds,
        last,
        float(errors.min()),
        float(np.median(errors)),
        ms,
    ]
    return row


def foreign(pieces: Pieces) -> Table:
    """Pairs without shared ground: how many are joined, and those that come nearest to it."""
    maps = _maps(pieces)
    found: list[tuple[float, float, str]] = []
    joined = 0
    costs = []
    for known, query in without_shared_ground(pieces):
        began = time.process_time()
        decision = recognize(maps[query.name], maps[known.name])
        costs.append(1e3 * (time.process_time() - began) / max(decision.views, 1))
        joined += decision.is_joined
        forward = -math.inf if decision.placement is None else decision.placement.log_odds
        found.append((forward, decision.log_odds, f'{known.name} <- {query.name}'))
    found.sort(reverse=True)
    above = sum(log_odds > 0.0 for _, log_odds, _ in found)
    rows: list[list[Any]] = [
        [f'{len(found)} pairs: joined', joined, None],
        ['log odds above 0', above, None],
        ['ms a view: median, most', float(np.median(costs)), max(costs)],
    ]
    rows += [[name, forward, least] for forward, least, name in found[:_NEAREST_FALSE]]
    return Table('foreign', ('pair', 'log odds', 'of both directions'), rows, timed=True)


def _drawn(piece: RecordedPiece) -> MapPiece:
    return MapPiece(drawn_scans(piece.patch, piece.graph), piece.patch, piece.graph)


def bare(pieces: Pieces) -> Table:
    """Grid and graph alone: scans are drawn. All pairs with shared ground, as many without."""
    maps = {piece.name: _drawn(piece) for piece in pieces}
    rows = []
    right = with_shared_ground(pieces)
    wrong = without_shared_ground(pieces)
    for known, query in [*right, *wrong[:: max(1, len(wrong) // max(len(right), 1))]]:
        began = time.process_time()
        decision = recognize(maps[query.name], maps[known.name])
        seconds = time.process_time() - began
        error = None
        if decision.placement is not None and is_shared(known, query):
            T_map_piece = decision.placement.T_map_piece
            error = float(rigid_errors(known, query, T_map_piece).min())
        name = f'{known.name} <- {query.name}'
        rows.append(
            [
                name,
                is_shared(known, query),
                decision.is_joined,
                decision.log_odds,
                error,
                seconds,
            ]
        )
    columns = ('map <- query', 'shared ground', 'joined', 'log odds', 'least error m', 'cpu s')
    return Table('bare', columns, rows, timed=True)


def joined(pieces: Pieces) -> Table:
    """Pairs that share ground, joined: errors between both, and ids of branch nodes."""
    columns = (
        'pair',
        'links',
        'rigid m: median',
        '95 %',
        'joined m: median',
        '95 %',
        'ids kept',
        'of',
        'found',
        'of',
        'recognition cpu s',
        'join cpu s',
    )
    rows = [
        _joined_row(known, query)
        for known, query in with_shared_ground(pieces)
        if known.name < query.name
    ]
    return Table('joined', columns, rows, timed=True)


def _joined_row(known: RecordedPiece, query: RecordedPiece) -> list[Any]:
    first = _slam_piece(known)
    second = _slam_piece(query)
    began = time.process_time()
    decision = recognize(second.places, first.places)
    recognized = time.process_time()
    if decision.placement is None or not decision.is_joined:
        return [f'{known.name} + {query.name}', *[None] * 11]
    is_simulated = not known.name.startswith(LOGS)
    grid = replace(PAPER_GRID, no_return_clear_range_m=LaserScannerConfig().range_max_m)
    merged = join(first, second, decision.placement, grid if is_simulated else None)
    ended = time.process_time()
    count = len(known.frames)
    poses = merged.piece.poses
    rigid = rigid_errors(known, query, decision.placement.T_map_piece)
    bent = relative_errors(known, query, poses[:count], poses[count:])
    own = _branches(known.graph)
    others = _branches(query.graph)
    return [
        f'{known.name} + {query.name}',
        merged.links,
        float(np.median(rigid)),
        float(np.quantile(rigid, 0.95)),
        float(np.median(bent)),
        float(np.quantile(bent, 0.95)),
        len(own & merged.piece.graph.nodes.keys()),
        len(own),
        len(others & merged.ids.keys()),
        len(others),
        recognized - began,
        ended - recognized,
    ]


def _branches(graph: TopologicalMap) -> set[int]:
    return {node.id for node in graph.nodes.values() if node.kind is NodeKind.BRANCH}


def _slam_piece(piece: RecordedPiece) -> SlamPiece:
    next_id = 1 + max([*piece.graph.nodes, *piece.graph.edges])
    return SlamPiece(piece.frames, piece.edges, piece.patch, piece.graph, next_id)


def _maps(pieces: Pieces) -> dict[str, MapPiece]:
    """Pieces by name, with what the search needs of them: it is not part of its time."""
    maps = {piece.name: MapPiece(piece.frames, piece.patch, piece.graph) for piece in pieces}
    for each in maps.values():
        _ = (each.index, each.views)
    return maps
