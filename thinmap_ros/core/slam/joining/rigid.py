"""One transform between two pieces of map that do not bend, by matches between both."""

from collections.abc import Iterable, Sequence

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array, inverse, propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.graph.pose_graph import Edge, optimized
from thinmap_ros.core.slam.joining.links import Prior, match_keyframes
from thinmap_ros.core.slam.joining.pieces import SlamPiece

_MAX_LINKS = 100  # for one transform; more take time


def rigid_links(first: SlamPiece, second: SlamPiece, priors: Sequence[Prior]) -> list[Edge]:
    """Matches of keyframes of the second piece with the first one, at predicted poses."""
    some = priors[:: 1 + len(priors) // _MAX_LINKS]
    return found(match_keyframes(first.frames, second.frames, some))


def found(links: Iterable[Edge | None]) -> list[Edge]:
    """The matches that did not fail."""
    return [link for link in links if link is not None]


def rigid_transform(first: SlamPiece, second: SlamPiece, T: Array, links: Sequence[Edge]) -> Array:
    """Pose T_first_second (3,) that the links agree on, from a rough one."""
    bodies = [_between_bodies(link, first, second) for link in links]
    return np.asarray(optimized(np.vstack([np.zeros(3), T]), bodies)[1])


def refined(first: SlamPiece, second: SlamPiece, T: Array) -> tuple[Array, int]:
    """Pose T_first_second (3,) near a given one by matches of all keyframes, and their number."""
    priors = [(k, se2.compose(T, own)) for k, own in enumerate(second.poses)]
    near = [(k, prior) for k, prior in priors if _is_near(first, prior)]
    links = rigid_links(first, second, near)
    return rigid_transform(first, second, T, links), len(links)


def _is_near(piece: SlamPiece, T: Array) -> bool:
    """Whether the known cells of a piece enclose a pose (3,)."""
    row, col = piece.patch.frame.cells_of(T[None, :2])[0].tolist()
    rows, cols = piece.patch.shape
    return bool(0 <= row < rows and 0 <= col < cols)


def _between_bodies(link: Edge, first: SlamPiece, second: SlamPiece) -> Edge:
    """A link as an edge from the frame of the first piece to that of the second."""
    T_first_a = first.poses[link.a]
    T_first_b = se2.compose(T_first_a, link.T_a_b)
    T_first_second = se2.compose(T_first_b, se2.invert(second.poses[link.b]))
    covariance = rotated_covariance(inverse(link.information), float(T_first_a[2]))
    covariance = propagated_covariance(covariance, T_first_second[:2] - T_first_b[:2])
    return Edge(0, 1, T_first_second, inverse(covariance), robust=True)
