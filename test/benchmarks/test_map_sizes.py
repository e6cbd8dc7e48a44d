"""Bytes of graphs and grids."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from benchmarks.graphs.floors import graph_in_bytes, grid_as_png, grid_in_bytes
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap


def graph() -> TopologicalMap:
    nodes = [Node(1, NodeKind.END, 1.0, 2.0, 0.5), Node(2, NodeKind.CORNER, 1.5, 2.0, 0.75)]
    path = np.array([[1.0, 2.0], [1.25, 2.0], [1.5, 2.0]])
    return TopologicalMap(nodes, [Edge(3, 1, 2, path, 0.5, 0.25)])


def test_a_graph_without_paths() -> None:
    data = graph_in_bytes(graph(), with_paths=False)
    assert len(data) == 2 * 17 + 20
    assert data[:5] == b'\x01\0\0\0\0'
    assert np.frombuffer(data[5:17], '<f4').tolist() == [1.0, 2.0, 0.5]
    assert np.frombuffer(data[34:46], '<u4').tolist() == [3, 1, 2]
    assert np.frombuffer(data[46:54], '<f4').tolist() == [0.5, 0.25]


def test_a_graph_with_paths() -> None:
    data = graph_in_bytes(graph(), with_paths=True)
    without = graph_in_bytes(graph(), with_paths=False)
    assert data.startswith(without)
    assert len(data) == len(without) + 4 + 3 * 8
    assert np.frombuffer(data[-24:], '<f4').tolist() == [1.0, 2.0, 1.25, 2.0, 1.5, 2.0]


def test_an_empty_graph_has_no_bytes() -> None:
    assert graph_in_bytes(TopologicalMap(), with_paths=True) == b''


def test_a_grid_is_the_rectangle_of_its_known_cells() -> None:
    cells = np.full((20, 30), -1, dtype=np.int8)
    cells[5:9, 10:20] = 3
    cells[8, 10] = 90
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    data = grid_in_bytes(patch)
    assert len(data) == 4 * 10
    assert set(data) == {0, 100}
    with Image.open(BytesIO(grid_as_png(patch))) as image:
        assert image.tobytes() == data


def test_a_grid_without_known_cells_is_refused() -> None:
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), np.full((3, 4), -1, dtype=np.int8))
    with pytest.raises(InputError, match='without known cells'):
        grid_in_bytes(patch)
