"""EKF-SLAM/TI: the conventional filter's estimate at a cost independent of the feature count.

Each step updates the pose and the features of a local area, A. Its effect on all other features, B,
is accumulated in a few numbers, and applied when the area changes. Source: EKF-SLAM/TI paper
section 4 for the area; the compressed filter after Guivant and Nebot, "Optimization of the
simultaneous localization and map-building algorithm for real-time implementation", 2001 (the
paper's reference [4]).

Let P_AB and P_BB be the covariances when the area was set. Then after any number of steps there is
a vector c and a matrix C with x_B = x_B + P_BA c and P_BB = P_BB + P_BA C P_AB, and each number a
of A has the cross covariance P_aB = Phi_a P_AB. A vector e with mean 0, covariance 0 and
cov(A, e) = I at that time evolves in the same way (B changes as P_BA e): its mean is c, its
covariance C, and its cross covariance Phi. So the local filter is the conventional filter with e
as part of its state, without a second set of equations.

Adding P_BA C P_AB to P_BB costs the square of the number of features. C is negative semidefinite,
so the term is -W' W with few rows. Only the rows of a new area are updated at once. The others
follow a few at a time, so that the time of each step is bounded.
"""

import math
import mmap
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.ekf_slam.ekf import EkfSlam
from thinmap_ros.core.se2 import Array, wrap

_ROOM = 8200  # numbers by which the store grows; memory is used only where it is written
_CHUNK = 256  # numbers by which the used width of the store grows
_SWEEP_STEPS = 384  # steps in which -W' W is added to the whole store
_BLOCK = 64  # smallest number of rows to update at once
_ROUNDING = 1e-15  # relative size of an eigenvalue below which it is rounding error


class CompressedEkf:
    """Pose and all features; `local` is the filter of the pose and the features of the area.

    The caller chooses the ids of features. `area` lists those of the local filter, in its order;
    change their number only by `add` and `remove` of this class. Until `set_local_area` is called,
    all features are in the area, and this is the conventional filter.
    """

    def __init__(self, T_map_base: Array, covariance: Array) -> None:
        self.local = EkfSlam(T_map_base, covariance)
        self.area: list[int] = []
        self._store = _Store()
        # P_AB when the area was set, (carried numbers, store's width);
        # the columns of the area itself are 0.
        self._cross: Array = np.zeros((0, self._store.width))
        # By feature id, the index of its pair of numbers in the store.
        self._places: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._places)

    @property
    def ids(self) -> list[int]:
        """Ids of all features."""
        return list(self._places)

    def add(self, feature_id: int, seen: Array, covariance: Array) -> int:
        """Add an observed line (r, alpha), robot frame, as a feature of the area.

        covariance (2, 2): of the observation. Returns the feature's index in the local filter.
        """
        self._places[feature_id] = self._store.take_place()
        if self._cross.shape[1] < self._store.width:
            self._cross = widened(self._cross, self._store.width)
        self.area.append(feature_id)
        return self.local.add(seen, covariance)

    def remove(self, index: int) -> None:
        """Remove a feature of the area, by its index in the local filter."""
        place = self._places.pop(self.area.pop(index))
        self._store.free_place(place)
        self.local.remove(index)

    def set_local_area(self, ids: list[int]) -> None:
        """Make these features the local area, and apply the steps so far to all others."""
        pose_cross = self._fold()
        at = self._numbers(ids)
        mean, rows = self._store.read(at)
        pose_covariance = self.local.pose_covariance
        own = np.block([[pose_covariance, pose_cross[:, at]], [pose_cross[:, at].T, rows[:, at]]])
        others = self._store.taken_but(at)
        self._cross = np.zeros((len(own) if others.size else 0, self._store.width))
        if others.size:
            self._cross[:, others] = np.vstack([pose_cross[:, others], rows[:, others]])
        self.local = _carrying(self.local.pose, mean, 0.5 * (own + own.T), len(self._cross))
        self.area = list(ids)

    def flush_step(self) -> None:
        """Update some rows of the store; to be called once per step."""
        self._store.sweep()

    def flush(self) -> tuple[Array, Array]:
        """Apply all steps to all features.

        Returns mean (3 + 2 N,) and covariance of pose and all features, in the order of `ids`.
        """
        area = self.area
        self.set_local_area(self.ids)
        mean = self.local.mean
        covariance = self.local.covariance
        self.set_local_area(area)
        return mean, covariance

    def restore(self, ids: list[int], lines: Array, covariance: Array) -> None:
        """Restore features with lines (N, 2) and covariance (2 N, 2 N) into an empty filter.

        They are uncorrelated with the pose. All are in the area until `set_local_area` is called.
        """
        for feature_id in ids:
            self._places[feature_id] = self._store.take_place()
        self._cross = np.zeros((0, self._store.width))
        mean = np.concatenate([self.local.pose, lines.ravel()])
        own = np.zeros((3 + lines.size,) * 2)
        own[:3, :3] = self.local.pose_covariance
        own[3:, 3:] = covariance
        self.local.set_state(mean, own)
        self.area = list(ids)

    def lines(self) -> dict[int, Array]:
        """Line (r, alpha) of every feature; outside the area as of when the area was set."""
        found = {i: self._store.mean[2 * p : 2 * p + 2] for i, p in self._places.items()}
        found.update(zip(self.area, self.local.lines, strict=True))
        return found

    def line_array(self) -> tuple[NDArray[np.int64], Array]:
        """Ids (N,) and lines (N, 2) of all features, as `lines`, in the order of `ids`."""
        lines = self._store.mean[: self._store.width].reshape(-1, 2).copy()  # by place
        lines[[self._places[i] for i in self.area]] = self.local.lines
        ids = np.fromiter(self._places, dtype=np.int64, count=len(self))
        return ids, lines[np.fromiter(self._places.values(), dtype=np.int64, count=len(self))]

    def line_covariances(self) -> dict[int, Array]:
        """Covariance (2, 2) of every line; outside the area as of when the area was set."""
        found = dict(zip(self.ids, self._store.blocks(list(self._places.values())), strict=True))
        found.update(zip(self.area, self.local.line_covariances(), strict=True))
        return found

    def _numbers(self, ids: list[int]) -> NDArray[np.int64]:
        """Indices (2 len(ids),) of the lines of features in the store."""
        places = np.array([self._places[i] for i in ids], dtype=np.int64)
        return np.asarray((2 * places[:, None] + np.arange(2)).ravel())

    def _fold(self) -> Array:
        """Update the store by all steps; returns cov(pose, numbers of the store), (3, width)."""
        mean = self.local.mean
        P = self.local.covariance
        first = self.local.first
        at = self._numbers(self.area)
        e = slice(3, first)
        self._store.move(mean[e] @ self._cross)
        squares, directions = np.linalg.eigh(-P[e, e])
        seen = squares > _ROUNDING * squares.max(initial=0.0)
        self._store.subtract((directions[:, seen] * np.sqrt(squares[seen])).T @ self._cross)
        rows = P[first:, e] @ self._cross
        pose_cross = P[:3, e] @ self._cross
        rows[:, at] = P[first:, first:]
        pose_cross[:, at] = P[:3, first:]
        self._store.write(at, mean[first:], rows)
        return np.asarray(pose_cross)


def _carrying(pose: Array, lines: Array, covariance: Array, carried: int) -> EkfSlam:
    """Filter of pose (3,) and lines (2 L,) with their covariance, and with cov(A, e) = I.

    carried: dimension of e.
    """
    local = EkfSlam(pose, covariance[:3, :3], carried)
    at = np.r_[0:3, 3 + carried : 3 + carried + lines.size]
    mean = np.zeros(at.size + carried)
    P = np.zeros((at.size + carried, at.size + carried))
    mean[at] = np.concatenate([pose, lines])
    P[np.ix_(at, at)] = covariance
    if carried:
        P[at, 3 : 3 + carried] = np.eye(carried)
        P[3 : 3 + carried, at] = np.eye(carried)
    local.set_state(mean, P)
    return local


class _Store:
    """Mean and covariance of all features as of the last change of the area.

    Some terms -W' W are not yet added to the covariance. Sweeps add them to rows and columns, from
    the first to the last. A sweep processes the terms that exist when it starts; later terms wait
    for the next sweep. Rows and columns that are written are up to date, so W is 0 there.
    """

    def __init__(self) -> None:
        self.mean: Array = np.zeros(_ROOM)
        self.width = _CHUNK  # numbers in use, in whole chunks
        self._P = _zeros(_ROOM)
        self._used = 0
        self._free: list[int] = []
        self._sweeping: Array = np.zeros((0, self.width))
        self._waiting: Array = np.zeros((0, self.width))
        self._row = 0  # number of rows and columns that the sweep has updated
        self._due = 0.0  # numbers that the sweep is behind schedule

    def take_place(self) -> int:
        """Allocate a place for a feature: its numbers are 2 place and 2 place + 1."""
        if self._free:
            return self._free.pop()
        self._used += 1
        if 2 * self._used > self.width:
            self.width += _CHUNK
            self._sweeping = widened(self._sweeping, self.width)
            self._waiting = widened(self._waiting, self.width)
        if self.width > self.mean.size:
            larger = _zeros(self.mean.size + _ROOM)
            self.mean = np.append(self.mean, np.zeros(_ROOM))
            larger[: len(self._P), : len(self._P)] = self._P
            self._P = larger
        return self._used - 1

    def free_place(self, place: int) -> None:
        """Release a place."""
        self._free.append(place)

    def taken_but(self, at: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of all allocated places except those at `at`, in order."""
        taken = np.zeros(self.width, dtype=np.bool_)
        taken[: 2 * self._used] = True
        taken[at] = False
        taken.reshape(-1, 2)[self._free] = False
        return np.flatnonzero(taken)

    def move(self, change: Array) -> None:
        """Add to the mean, (width,)."""
        self.mean[: self.width] += change
        self.mean[1 : self.width : 2] = wrap(self.mean[1 : self.width : 2])

    def read(self, at: NDArray[np.int64]) -> tuple[Array, Array]:
        """Current mean (M,) and rows (M, width) of the covariance at numbers `at` (M,)."""
        rows = self._P[at, : self.width]
        late = at >= self._row
        row = self._row
        rows[late, row:] -= self._sweeping[:, at[late]].T @ self._sweeping[:, row:]
        rows -= self._waiting[:, at].T @ self._waiting
        return self.mean[at], rows

    def write(self, at: NDArray[np.int64], mean: Array, rows: Array) -> None:
        """Set mean (M,), and rows (M, width) and columns of the covariance, at numbers (M,)."""
        self.mean[at] = mean
        self._P[at, : self.width] = rows
        self._P[: self.width, at] = rows.T
        self._sweeping[:, at] = 0.0
        self._waiting[:, at] = 0.0

    def blocks(self, places: list[int]) -> Array:
        """Current covariances (N, 2, 2) of the features at some places."""
        at = 2 * np.array(places, dtype=np.int64)[:, None] + np.arange(2)
        found = self._P[at[:, :, None], at[:, None, :]]
        swept = np.where(at[:, 0] >= self._row, 1.0, 0.0)[:, None, None]
        found -= swept * np.einsum('kia,kib->iab', self._sweeping[:, at], self._sweeping[:, at])
        return np.asarray(
            found - np.einsum('kia,kib->iab', self._waiting[:, at], self._waiting[:, at])
        )

    def subtract(self, W: Array) -> None:
        """Subtract W' W from the covariance in later sweeps; W (R, width)."""
        self._waiting = np.vstack([self._waiting, W])

    def sweep(self) -> None:
        """Update some rows, and their columns, of the covariance."""
        if len(self._sweeping) == 0:
            self._sweeping, self._waiting, self._row = self._waiting, self._sweeping, 0
        if len(self._sweeping) == 0:
            return
        # Only the triangle is computed, so rows become shorter; a step's share is one of its area.
        # Shares accumulate until they are enough for a block.
        end = 2 * self._used
        a = self._row
        self._due += 0.5 * end * end / _SWEEP_STEPS
        if self._due < _BLOCK * (end - a) and self._due < 0.5 * (end - a) ** 2:
            return
        b = min(a + math.ceil(self._due / (end - a)), end)
        self._due = 0.0
        block = self._sweeping[:, a:b].T @ self._sweeping[:, a:end]
        self._P[a:b, a:end] -= block
        self._P[b:end, a:b] -= block[:, b - a :].T
        self._row = b
        if b == end:
            self._sweeping = self._sweeping[:0]


def _zeros(size: int) -> Array:
    """Zeros (size, size) that use memory only where they are written.

    numpy would use huge pages, and each row with a few numbers in use would occupy a whole page.
    """
    pages = mmap.mmap(-1, 8 * size * size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(AttributeError, OSError):  # no huge pages on this system
        pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype=np.float64).reshape(size, size)


def widened(rows: Array, width: int) -> Array:
    """Rows (R, W), padded with zeros to a width."""
    return np.pad(rows, ((0, 0), (0, width - rows.shape[1])))
