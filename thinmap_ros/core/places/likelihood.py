"""What poses are worth in view of one scan.

The map's arrays and the noise are bound to the loops over them.
"""

import math

import numpy as np

from thinmap_ros.core.places import likelihood_kernels
from thinmap_ros.core.places.config import GlobalLocalizationConfig
from thinmap_ros.core.places.observation import Observation
from thinmap_ros.core.places.observation_model import NodeModel
from thinmap_ros.core.places.place_database import NEAR_UNIT_M, Places
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array

# A beam that one place explains and another does not: about 1 in log odds, but beams that miss come
# in groups.
LOG_ODDS_A_BEAM = 0.35
# A beam of which the map says nothing, counted in beams that it explains: what is unknown there may
# well be like that.
SILENT_COUNTS = 0.75
HEADING_NOISE_RAD = 0.01  # standard deviation of the heading of a correct hypothesis
# From afar to near: how wide a wall's pull is, 1 sigma, m, and the steps uphill, m and rad.
_PULLS: tuple[tuple[float, Array], ...] = (
    (0.30, np.array([[0.16, 0.06], [0.08, 0.03]])),
    (0.15, np.array([[0.08, 0.03], [0.04, 0.015]])),
)
_OUTLIERS = 0.1
# Beams are not independent of each other: neighbours meet the same wall, which the map has drawn
# once, and well or not.
_BEAMS_PER_OBSERVATION = 6.0
_NODES_PER_OBSERVATION = 2.0
_FINE_STEPS = np.array([[0.04, 0.015], [0.02, 0.0075]])
_ROUNDS = 6
_MIN_COVARIANCE = np.diag([0.02**2, 0.02**2, 0.01**2])


class Judge:
    """Compares poses with observations.

    Tolerances follow from the cells of the grid and the noise of the sensor.
    """

    def __init__(self, places: Places, config: GlobalLocalizationConfig, nodes: NodeModel) -> None:
        self._places = places
        self._nodes = nodes
        self._origin = (places.frame.origin_x, places.frame.origin_y)
        # A wall lies anywhere in its cell, and so does the end of a beam: uniform, twice.
        cells = places.frame.resolution / math.sqrt(6.0)
        sigma = math.sqrt(config.beam_noise_m**2 + config.map_noise_m**2 + cells**2)
        self.tolerance = (BOUND_SIGMAS * sigma, BOUND_SIGMAS * HEADING_NOISE_RAD)
        off = np.arange(256) * NEAR_UNIT_M / sigma
        bell = np.exp(-0.5 * off**2)
        self._log_table = np.log((1.0 - _OUTLIERS) * bell + _OUTLIERS) / _BEAMS_PER_OBSERVATION
        self._pulls = [(np.exp(-0.5 * (off * sigma / pull) ** 2), steps) for pull, steps in _PULLS]

    def log_likelihoods(self, poses: Array, seen: Observation) -> Array:
        """Log likelihood of beams and nodes at poses (N, 3), up to a constant, (N,)."""
        ends = seen.ends[seen.met]
        near = self._places.near
        resolution = self._places.frame.resolution
        scores = likelihood_kernels.range_scores(
            poses, ends, near, self._origin, resolution, self._log_table
        )
        return np.asarray(scores + self.node_log_ratios(poses, seen))

    def node_log_ratios(self, poses: Array, seen: Observation) -> Array:
        """Log likelihood ratio (N,) of observed nodes at poses (N, 3), against a pose anywhere."""
        places = self._places
        model = self._nodes
        ratios = likelihood_kernels.node_scores(
            poses,
            seen.nodes,
            seen.node_kinds,
            (places.blocks, places.first, places.in_sight),
            self._origin,
            places.block_cells * places.frame.resolution,
            model.found,
            model.spread_m,
            model.gain,
        )
        return np.asarray(ratios / _NODES_PER_OBSERVATION)

    def refined(
        self,
        poses: Array,
        seen: Observation,
        covariances: Array | None = None,
        others: Array | None = None,
    ) -> Array:
        """Poses (N, 3) moved to where the beams fit best near by.

        covariances (N, 3, 3): how far that may be.

        Once straight from where they are, once from where they fit when walls pull from far, and,
        where others (N, 3) are given, once from there: whichever fits better.
        """
        free = np.zeros((len(poses), 3, 3))
        held: Array = free
        if covariances is not None:
            held = np.asarray(np.linalg.inv(covariances + _MIN_COVARIANCE))
        near, near_score = self._uphill(poses, seen, self._log_table, _FINE_STEPS, poses, held)
        far = poses
        for table, steps in self._pulls:
            far, _ = self._uphill(far, seen, table, steps, poses, free)
        far, far_score = self._uphill(far, seen, self._log_table, _FINE_STEPS, poses, held)
        best = np.where((far_score > near_score)[:, None], far, near)
        score = np.maximum(far_score, near_score)
        if others is not None:
            other, other_score = self._uphill(
                others, seen, self._log_table, _FINE_STEPS, poses, held
            )
            best = np.where((other_score > score)[:, None], other, best)
        return best

    def unblocked(self, poses: Array, seen: Observation, others: Array) -> Array:
        """Poses (N, 3), or what of others (N, K, 3) explains more where they leave beams out.

        Ends of beams alone do not tell how far along a corridor a robot is that looks through a
        door: from beside the door, they end on walls just as well, but on their way they would have
        to pass one.
        """
        left = np.flatnonzero(self._left_out(poses, seen) > 0.0)
        if not len(left):
            return poses
        tried = np.concatenate([poses[left, None], others[left]], axis=1)
        flat = tried.reshape(-1, 3)
        worth = self.log_likelihoods(flat, seen) - LOG_ODDS_A_BEAM * self._left_out(flat, seen)
        best = worth.reshape(len(left), -1).argmax(axis=1)
        result = poses.copy()
        result[left] = tried[np.arange(len(left)), best]
        return result

    def _left_out(self, poses: Array, seen: Observation) -> Array:
        """How many beams the map does not explain from poses (N, 3), (N,)."""
        counts, silent = self.explained(poses, seen)
        return np.asarray(len(seen.ranges_m) - counts - SILENT_COUNTS * silent)

    def _uphill(
        self,
        poses: Array,
        seen: Observation,
        table: Array,
        steps: Array,
        expected: Array,
        held: Array,
    ) -> tuple[Array, Array]:
        near = self._places.near
        resolution = self._places.frame.resolution
        ends = seen.ends[seen.met]
        return likelihood_kernels.refine(
            poses, ends, near, self._origin, resolution, table, steps, _ROUNDS, expected, held
        )

    def explained(self, poses: Array, seen: Observation) -> tuple[Array, Array]:
        """How many beams the map explains from poses (N, 3), and is silent on, (N,) each."""
        places = self._places
        return likelihood_kernels.explained(
            poses,
            seen.laser,
            seen.ranges_m,
            seen.bearings_rad,
            seen.met,
            (places.states, places.near),
            self._origin,
            places.frame.resolution,
            self.tolerance,
        )
