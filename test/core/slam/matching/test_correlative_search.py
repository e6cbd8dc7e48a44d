"""Branch and bound, compared with exhaustive search over its finest lattice."""

import math

import numpy as np
import pytest
from support.local_map_cells import cells_of, nearest
from support.slam_room import ROOM, around, map_of, seen_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.matching import scan_matcher
from thinmap_ros.core.slam.matching.local_map import MAX_WALL_DISTANCE_M, LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import (
    SLIP_SIGMAS,
    UNSEEN_COST,
    Matcher,
    search,
    weighted_points,
)

MATCHER = Matcher()
CELL_M = LocalMapConfig().resolution_m
SIGMA_M = MATCHER.config.noise_m
NOISE = (SIGMA_M, MATCHER.config.kernel_scale_m / SIGMA_M)
FAR = MAX_WALL_DISTANCE_M / SIGMA_M
PLENTY = 1_000_000  # nodes
ROOT_M = 4.0 * CELL_M  # half the size of a root


def cauchy(squared, width):
    return 0.5 * width**2 * np.log1p(squared / width**2)


class Exhaustive:
    """Reference: cost of poses by the nearest wall of each cell, by brute force."""

    def __init__(self, local_map):
        self.cells, self.top, self.left = cells_of(local_map)
        self.away = nearest(self.cells) * CELL_M / SIGMA_M

    def costs(self, scan, poses, prior, information):
        """Costs (P,) of a scan (N, 3) at poses (P, 3), with that of the prior."""
        parts = np.array_split(poses, 1 + len(poses) // 2000)
        scan_information = np.concatenate([self._of_points(scan, part) for part in parts])
        off = poses - prior
        off[:, 2] = se2.wrap(off[:, 2])
        squared = np.einsum('ni,ij,nj->n', off, information, off)
        return scan_information + cauchy(squared, SLIP_SIGMAS)

    def _of_points(self, scan, poses):
        c = np.cos(poses[:, 2:])
        s = np.sin(poses[:, 2:])
        x = poses[:, :1] + c * scan[:, 0] - s * scan[:, 1]
        y = poses[:, 1:2] + s * scan[:, 0] + c * scan[:, 1]
        row = np.floor(y / CELL_M).astype(int) - self.top
        col = np.floor(x / CELL_M).astype(int) - self.left
        rows, cols = self.away.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        at = (np.where(inside, row, 0), np.where(inside, col, 0))
        away = np.where(inside, self.away[at], np.inf)
        share = np.where(inside & (self.cells['seen'][at] > 0), 1.0, UNSEEN_COST)
        beyond = share * cauchy(FAR**2, NOISE[1])
        near = np.isfinite(away)
        costs = np.where(near, cauchy(np.where(near, away, 0.0) ** 2, NOISE[1]), beyond)
        return costs @ scan[:, 2]


def leaves(scan, prior, half):
    """All poses (P, 3) of the finest lattice within half (3,) of a prior."""
    radius = max(float(np.median(np.hypot(*scan[:, :2].T))), 1.0)
    offsets = []
    for size, reach in zip([ROOT_M, ROOT_M, ROOT_M / radius], half, strict=True):
        number = int(reach / (2.0 * size) + 0.5)
        roots = 2.0 * size * np.arange(-number, number + 1)
        parts = size * np.array([-0.75, -0.25, 0.25, 0.75])
        offsets.append((roots[:, None] + parts).ravel())
    return np.stack(np.meshgrid(*offsets, indexing='ij'), axis=-1).reshape(-1, 3) + prior


class Case:
    """A scan in a map of the room, and a prior near its true pose."""

    def __init__(self, seed, slips=False):
        rng = np.random.default_rng(seed)
        self.truth = np.array([*rng.uniform(1.0, 9.0, 2), rng.uniform(-3.0, 3.0)])
        poses = around(self.truth, int(rng.integers(3, 10)), rng)
        self.local_map = map_of(ROOM, poses, rng)
        scan = weighted_points(seen_in(ROOM, self.truth, rng), np.zeros(3), CELL_M)[:, :3]
        self.scan = np.ascontiguousarray(scan[:: max(1, len(scan) // 45)])
        sigmas = rng.uniform(0.005, 0.04, 3) if slips else rng.uniform(0.05, 0.25, 3)
        self.information = np.linalg.inv(np.diag(sigmas**2))
        slip = np.hypot(sigmas, [0.2, 0.2, 0.15]) if slips else sigmas
        self.prior = self.truth + rng.uniform(-2.0, 2.0, 3) * slip
        self.half = 3.0 * np.minimum(slip, 0.2)

    def found(self, incumbent, most_nodes=PLENTY, kernel=search):
        rest = (self.local_map.lattice, *NOISE, most_nodes)
        return kernel(self.scan, self.prior, self.information, self.half, incumbent, *rest)

    def costs(self, poses):
        reference = Exhaustive(self.local_map)
        return reference.costs(self.scan, np.atleast_2d(poses), self.prior, self.information)


def exact(cases, most_nodes):
    """Gaps (N,) between the found cost and the lowest one of all leaves and the incumbent."""
    gaps = []
    better = 0
    for case in cases:
        found = case.found(case.prior, most_nodes)
        cost, incumbent = case.costs(np.vstack([found, case.prior]))
        assert cost <= incumbent + 1e-6
        better += cost < incumbent - 1.0
        leaf = case.costs(leaves(case.scan, case.prior, case.half)).min()
        gaps.append(cost - min(leaf, incumbent))
    assert min(gaps) > -1e-6, 'nothing but leaves and the incumbent is ever returned'
    assert better > 0.7 * len(gaps), 'the incumbent is not the best already'
    return np.array(gaps) < 1e-6, np.array(gaps)


@pytest.mark.parametrize('most_nodes', [PLENTY, 1000])
def test_the_search_finds_the_least_of_its_lattice(most_nodes):
    """In nearly all cases: points out of reach of walls are assumed to stay out of reach."""
    found, gaps = exact([Case(seed) for seed in range(60)], most_nodes)
    assert found.mean() >= 0.95
    assert gaps.max() < 30.0


def test_after_wheel_slip_the_search_finds_nearly_the_lowest_cost():
    """Far from a narrow prior, whose cost varies much within a node."""
    found, gaps = exact([Case(seed, slips=True) for seed in range(60)], 1000)
    assert found.mean() >= 0.95
    assert gaps.max() < 20.0


def test_the_search_never_returns_worse_than_the_incumbent(rng):
    kept = 0
    for seed in range(30):
        case = Case(seed)
        for spread, nodes in ((0.02, PLENTY), (0.02, 20), (0.5, 100), (0.5, 0)):
            incumbent = case.truth + spread * rng.normal(0.0, 1.0, 3)
            given = incumbent.copy()
            found = case.found(incumbent, nodes)
            np.testing.assert_array_equal(incumbent, given)
            before, after = case.costs(np.vstack([incumbent, found]))
            assert after <= before + 1e-6
            kept += (found == incumbent).all()
    assert 30 < kept < 110


def test_a_prior_at_half_a_turn_is_searched_on_both_sides():
    """A heading may be given modulo a full turn."""
    case = Case(7)
    turned = Case(7)
    turned.prior = case.prior + [0.0, 0.0, 2.0 * math.pi]
    found = [each.found(case.prior) for each in (case, turned)]
    np.testing.assert_allclose(found[1] - found[0], [0.0, 0.0, 2.0 * math.pi], atol=1e-9)


@pytest.mark.parametrize('most_nodes', [0, 8, 40])
def test_no_more_nodes_are_tried_than_allowed(monkeypatch, most_nodes):
    """Except the root nodes and the children of the last node."""
    tried = []
    cost = scan_matcher._cost

    def counted(scan, pose, lattice, sigma, width, slack, most):
        tried.append(slack)
        return cost(scan, pose, lattice, sigma, width, slack, most)

    monkeypatch.setattr(scan_matcher, '_cost', counted)
    ended = 0
    for seed in range(8):
        case = Case(seed)
        tried.clear()
        case.found(case.prior, most_nodes, search.py_func)
        below = sum(1 for slack in tried[1:] if slack < 4.0)
        assert below <= most_nodes + 8
        ended += below > most_nodes - 8
    assert ended >= 6, 'it would have tried more'


def test_the_search_is_what_it_is_in_plain_python():
    for seed in range(3):
        case = Case(seed)
        case.half = np.array([0.25, 0.25, 0.1])
        incumbent = case.prior + [0.3, 0.0, 0.1]
        np.testing.assert_allclose(
            case.found(incumbent), case.found(incumbent, kernel=search.py_func), rtol=1e-12
        )


def test_the_cost_is_that_of_the_reference_and_its_bound_is_lower(rng):
    """Change of the cost within a node if all points are within reach of walls."""
    violations = 0
    compared = 0
    for seed in range(20):
        case = Case(seed)
        away = np.hypot(*case.scan[:, :2].T)
        radius = max(float(np.median(away)), 1.0)
        moving = np.column_stack([case.scan, 1.4 + away / radius])
        lattice = case.local_map.lattice

        def cost(pose, slack, moving=moving, lattice=lattice):
            return scan_matcher._cost(moving, pose, lattice, *NOISE, slack, np.inf)

        flat = 1e-12 * np.eye(3)
        reference = Exhaustive(case.local_map)
        for _ in range(20):
            node = case.truth + rng.normal(0.0, [0.05, 0.05, 0.02])
            for pose in (node, node + rng.uniform(-5.0, 5.0, 3)):
                expected = reference.costs(case.scan, pose[None], pose, flat)[0]
                assert cost(pose, 0.0) == pytest.approx(expected, rel=1e-9, abs=1e-9)
            for slack in (2.0, 4.0):
                leaf = 0.75 if slack == 4.0 else 0.5
                corner = rng.choice([-leaf, leaf], 3) * slack * CELL_M
                inside = node + corner * [1.0, 1.0, 1.0 / radius]
                compared += 1
                violations += cost(node, slack) > cost(inside, 0.0) + 1e-9
            assert cost(node, 4.0) <= cost(node, 2.0) <= cost(node, 0.0)
    assert violations < 0.03 * compared
