"""Edges of a graph that grows, as arrays: of a long drive there are tens of thousands."""

from collections.abc import Iterable, Sequence
from typing import overload

import numpy as np

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.pose_graph import Edge, EdgeArrays, Systematic
from thinmap_ros.core.slam.graph.rows import Rows


class EdgeTable(Sequence[Edge]):
    """A sequence of edges, each made of its row of the arrays."""

    def __init__(self, edges: Iterable[Edge] = ()) -> None:
        self._ends = Rows(2, dtype=np.int64)
        self._T_a_b = Rows(3)
        self._information = Rows(3, 3)
        self._robust = Rows(dtype=np.bool_)
        self._inlier_ratio = Rows()
        self._derivative = Rows(3, 4)
        self._parameters = Rows(4)
        self._spans = Rows(dtype=np.int64)
        self.extend(edges)

    def __len__(self) -> int:
        return len(self._ends)

    @overload
    def __getitem__(self, index: int) -> Edge: ...
    @overload
    def __getitem__(self, index: slice) -> list[Edge]: ...
    def __getitem__(self, index: int | slice) -> Edge | list[Edge]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        a, b = self._ends.values[index].tolist()
        share = Systematic(
            self._derivative.values[index].copy(),
            self._parameters.values[index].copy(),
            int(self._spans.values[index]),
        )
        return Edge(
            a,
            b,
            self._T_a_b.values[index].copy(),
            self._information.values[index].copy(),
            bool(self._robust.values[index]),
            share,
            float(self._inlier_ratio.values[index]),
        )

    def append(self, edge: Edge) -> None:
        """Add an edge."""
        self._ends.append((edge.a, edge.b))
        self._T_a_b.append(edge.T_a_b)
        self._information.append(edge.information)
        self._robust.append(edge.robust)
        self._inlier_ratio.append(edge.inlier_ratio)
        self._derivative.append(edge.systematic.derivative)
        self._parameters.append(edge.systematic.parameters)
        self._spans.append(edge.systematic.spans)

    def extend(self, edges: Iterable[Edge]) -> None:
        """Add edges."""
        for edge in edges:
            self.append(edge)

    @property
    def ends(self) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        """Keyframes a and b of each edge, (M, 2)."""
        return self._ends.values

    @property
    def information(self) -> Array:
        """Information (M, 3, 3) of each edge, which may be changed in place."""
        return self._information.values

    @property
    def derivatives(self) -> Array:
        """Derivative (M, 3, 4) of each relative pose by the calibration."""
        return self._derivative.values

    def arrays(self, parameters: Array | None = None) -> EdgeArrays:
        """The edges, as they are or would be with parameters (N, 4) of the calibration."""
        a, b = self._ends.values.T.copy()
        T_a_b = self._T_a_b.values + (0.0 if parameters is None else self._change(parameters))
        return EdgeArrays(a, b, T_a_b, self.information.copy(), self._robust.values.copy())

    def calibrate(self, parameters: Array) -> None:
        """Correct the edges by parameters (N, 4) of the calibration, by the number of spans."""
        self._T_a_b.values[:] += self._change(parameters)
        self._parameters.values[:] = parameters[self._spans.values]

    def _change(self, parameters: Array) -> Array:
        """Change (M, 3) of the relative poses with parameters (N, 4), by the number of spans."""
        by = parameters[self._spans.values] - self._parameters.values
        return np.asarray((self.derivatives @ by[:, :, None])[:, :, 0])
