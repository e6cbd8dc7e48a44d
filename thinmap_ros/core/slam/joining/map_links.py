"""Links between the maps of several robots: which are joined, and where each lies."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array, inverse, propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.graph.pose_graph import Edge, optimized
from thinmap_ros.core.slam.odometry import CHI2


@dataclass(frozen=True, eq=False)
class MapLink:
    """Pose T_a_b (3,) of map b in the frame of map a, with covariance (3, 3), frame of a.

    log_odds: that it is right; infinite where a person gave it. matches: scans that agree on it.
    """

    a: str
    b: str
    T_a_b: Array
    covariance: Array
    log_odds: float
    matches: int = 0

    @property
    def is_given(self) -> bool:
        """Whether a person gave it."""
        return math.isinf(self.log_odds)

    def reversed(self) -> 'MapLink':
        """The link from b to a."""
        T_b_a = se2.invert(self.T_a_b)
        turned = rotated_covariance(self.covariance, float(T_b_a[2]))
        covariance = propagated_covariance(turned, T_b_a[:2])
        return MapLink(self.b, self.a, T_b_a, covariance, self.log_odds, self.matches)

    def then(self, other: 'MapLink') -> 'MapLink':
        """The link from a to the end of another link, which begins at b."""
        T = se2.compose(self.T_a_b, other.T_a_b)
        own = propagated_covariance(self.covariance, T[:2] - self.T_a_b[:2])
        covariance = own + rotated_covariance(other.covariance, float(self.T_a_b[2]))
        log_odds = min(self.log_odds, other.log_odds)
        return MapLink(self.a, other.b, T, covariance, log_odds)

    def contradicts(self, other: 'MapLink') -> bool:
        """Whether another link between the same maps cannot be right if this one is."""
        off = se2.pose_difference(other.T_a_b, self.T_a_b)
        expected = self.covariance + other.covariance
        return float(off @ np.linalg.solve(expected, off)) > CHI2


class MapLinks:
    """The links between maps by their names, at most one for each pair.

    The surest links that connect the maps decide. A link that contradicts them is dropped.
    """

    def __init__(self) -> None:
        self._links: dict[frozenset[str], MapLink] = {}

    def __iter__(self) -> Iterator[MapLink]:
        """All links."""
        return iter(self._links.values())

    def between(self, a: str, b: str) -> MapLink | None:
        """The link from a to b, or None."""
        link = self._links.get(frozenset((a, b)))
        return link if link is None or link.a == a else link.reversed()

    def chain(self, a: str, b: str) -> MapLink | None:
        """The chain of the surest links from a to b, or None."""
        return self._chains(a).get(b)

    def add(self, link: MapLink) -> list[MapLink]:
        """Add a link, or replace that of its pair; returns the links that are dropped for it."""
        self._links[frozenset((link.a, link.b))] = link
        tree = self._tree()
        dropped = [other for other in self if other not in tree and self._is_wrong(other)]
        for other in dropped:
            del self._links[frozenset((other.a, other.b))]
        return dropped

    def remove(self, name: str) -> None:
        """Remove all links of a map."""
        self._links = {pair: link for pair, link in self._links.items() if name not in pair}

    def discard(self, link: MapLink) -> bool:
        """Remove a link, if it is still the one of its pair; returns whether it was."""
        pair = frozenset((link.a, link.b))
        is_there = self._links.get(pair) is link
        if is_there:
            del self._links[pair]
        return is_there

    def places(self, reference: str) -> dict[str, Array]:
        """Pose (3,) of each map that is connected with a reference, in the frame of that."""
        chains = self._chains(reference)
        names = list(chains)
        number = {name: k for k, name in enumerate(names)}
        poses = np.array([chain.T_a_b for chain in chains.values()])
        edges = [
            Edge(number[link.a], number[link.b], link.T_a_b, inverse(link.covariance), False)
            for link in self
            if link.a in number
        ]
        if len(edges) >= len(names):  # otherwise there is no cycle
            poses = optimized(poses, edges)
        return dict(zip(names, poses, strict=True))

    def _is_wrong(self, link: MapLink) -> bool:
        return link.contradicts(self._chains(link.a)[link.b])

    def _tree(self) -> list[MapLink]:
        """The surest links that connect all that is connected."""
        group = {name: name for pair in self._links for name in pair}
        tree = []
        for link in sorted(self, key=lambda each: -each.log_odds):
            kept = group[link.a]
            gone = group[link.b]
            if kept != gone:
                tree.append(link)
                group = {name: kept if of == gone else of for name, of in group.items()}
        return tree

    def _chains(self, start: str) -> dict[str, MapLink]:
        """Chain of the surest links from a map to each that is connected with it, itself first."""
        beside: dict[str, list[MapLink]] = {}
        for link in self._tree():
            beside.setdefault(link.a, []).append(link)
            beside.setdefault(link.b, []).append(link.reversed())
        chains = {start: MapLink(start, start, np.zeros(3), np.zeros((3, 3)), math.inf)}
        waiting = [start]
        while waiting:
            here = waiting.pop(0)
            for link in beside.get(here, []):
                if link.b not in chains:
                    chains[link.b] = chains[here].then(link)
                    waiting.append(link.b)
        return chains
