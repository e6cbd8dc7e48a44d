"""EKF-SLAM/TI: the conventional filter's estimate at a cost independent of the feature count.

Steps touch the pose and the features of a local area, A. What they would do to all other features,
B, is gathered in a few numbers and worked in when the area changes. Source: EKF-SLAM/TI paper
section 4 for the area; the compressed filter after Guivant and Nebot, "Optimization of the
simultaneous localization and map-building algorithm for real-time implementation", 2001 (the
paper's reference [4]).

With the covariances at the time when the area was entered, P_AB and P_BB, there is a matrix C and a
vector c so that now x_B = x_B + P_BA c and P_BB = P_BB + P_BA C P_AB, and each number a of A has
the cross terms P_aB = Phi_a P_AB. That is just what happens to a vector e with mean 0, covariance 0
and cov(A, e) = I on entering (B moves as P_BA e), whose mean c, covariance C and cross terms Phi
the filter itself keeps up when e is carried in its state. So there is no second set of equations:
the local filter is the conventional one with e carried along.

Folding P_BA C P_AB into P_BB costs the square of the number of features. C is negative, so the term
is -W' W with few rows; reading only what a new area needs and working off W a few rows at each step
keeps every step short.
"""

import math
import mmap
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.ekf_slam.ekf import EkfSlam
from thinmap_ros.core.se2 import Array, wrap

_ROOM = 8200  # numbers by which the store grows; memory is taken up only where it is written
_CHUNK = 256  # numbers by which what is computed with grows
_SWEEP_STEPS = 384  # in so many steps a fold is worked in
_BLOCK = 64  # rows that are worth a look at W
_ROUNDING = 1e-15  # eigenvalues this much smaller than the largest are nothing but rounding


class CompressedEkf:
    """Pose and all features; `local` is the filter of pose and the features of the area.

    Features are known by ids of the caller's choice. `area` lists those of the local filter, in its
    order; change the number of its features only by `add` and `remove` of this class. As long as
    `enter` is never called, all features are in the area, and this is the conventional filter.
    """

    def __init__(self, T_map_base: Array, covariance: Array) -> None:
        self.local = EkfSlam(T_map_base, covariance)
        self.area: list[int] = []
        self._store = _Store()
        # P_AB on entering the area, (carried numbers, store's width);
        # the columns of the area itself are 0.
        self._cross: Array = np.zeros((0, self._store.width))
        # By id, which pair of the store's numbers is the feature's.
        self._places: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._places)

    @property
    def ids(self) -> list[int]:
        """All features."""
        return list(self._places)

    def add(self, feature_id: int, seen: Array, covariance: Array) -> int:
        """Take up a line seen as (r, alpha) as a new feature of the area.

        Returns its index in the local filter.
        """
        self._places[feature_id] = self._store.take_place()
        if self._cross.shape[1] < self._store.width:
            self._cross = widened(self._cross, self._store.width)
        self.area.append(feature_id)
        return self.local.add(seen, covariance)

    def remove(self, index: int) -> None:
        """Drop a feature of the area, by its index in the local filter."""
        place = self._places.pop(self.area.pop(index))
        self._store.free_place(place)
        self.local.remove(index)

    def set_local_area(self, ids: list[int]) -> None:
        """Make these features the local area.

        What the steps so far mean for all others is folded in.
        """
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
        """Work some rows of what was folded into the store; to be called once a step."""
        self._store.sweep()

    def flush(self) -> tuple[Array, Array]:
        """Work everything in.

        Mean (3 + 2 N,) and covariance of pose and all features, in the order of `ids`.
        """
        area = self.area
        self.set_local_area(self.ids)
        mean = self.local.mean
        covariance = self.local.covariance
        self.set_local_area(area)
        return mean, covariance

    def restore(self, ids: list[int], lines: Array, covariance: Array) -> None:
        """Take up features with lines (N, 2) and covariance (2 N, 2 N), into a filter without any.

        The pose has nothing to do with them. All are in the area until another one is entered.
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
        """Line (r, alpha) of every feature.

        Of those outside the area, as of when the area was entered.
        """
        found = {i: self._store.mean[2 * p : 2 * p + 2] for i, p in self._places.items()}
        found.update(zip(self.area, self.local.lines, strict=True))
        return found

    def line_array(self) -> tuple[NDArray[np.int64], Array]:
        """Ids (N,) and lines (N, 2) of all features, in the order of `ids`, as `lines` has them."""
        lines = self._store.mean[: self._store.width].reshape(-1, 2).copy()  # by place
        lines[[self._places[i] for i in self.area]] = self.local.lines
        ids = np.fromiter(self._places, dtype=np.int64, count=len(self))
        return ids, lines[np.fromiter(self._places.values(), dtype=np.int64, count=len(self))]

    def line_covariances(self) -> dict[int, Array]:
        """Covariance (2, 2) of every feature's line.

        Of those outside the area, as of when the area was entered.
        """
        found = dict(zip(self.ids, self._store.blocks(list(self._places.values())), strict=True))
        found.update(zip(self.area, self.local.line_covariances(), strict=True))
        return found

    def _numbers(self, ids: list[int]) -> NDArray[np.int64]:
        """Where the lines of features stand in the store, (2 len(ids),)."""
        places = np.array([self._places[i] for i in ids], dtype=np.int64)
        return np.asarray((2 * places[:, None] + np.arange(2)).ravel())

    def _fold(self) -> Array:
        """Bring the store up to date; returns cov(pose, each number of the store), (3, width)."""
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
    """A filter of pose (3,) and lines (2 L,) with their covariance, and e between them.

    It has cov(A, e) = I.
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
    """Mean and covariance of all features as of the last fold.

    To the covariance a few terms -W' W are still to be added. These are worked off in sweeps over
    rows and columns, from the first to the last. A sweep takes what is there when it begins; what
    comes meanwhile waits for the next. Rows and columns that are written are up to date, so the
    terms are zero there from then on.
    """

    def __init__(self) -> None:
        self.mean: Array = np.zeros(_ROOM)
        self.width = _CHUNK  # numbers in use, in whole chunks
        self._P = _zeros(_ROOM)
        self._used = 0
        self._free: list[int] = []
        self._sweeping: Array = np.zeros((0, self.width))
        self._waiting: Array = np.zeros((0, self.width))
        self._row = 0  # rows and columns before this have been swept
        self._due = 0.0  # numbers that should have been swept by now beyond that

    def take_place(self) -> int:
        """A place for a feature: its numbers are 2 place and 2 place + 1."""
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
        """Give a place back."""
        self._free.append(place)

    def taken_but(self, at: NDArray[np.int64]) -> NDArray[np.int64]:
        """All numbers of places that are taken, in order, but some."""
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
        """Mean and rows of the covariance (len(at), width) at some numbers, up to date."""
        rows = self._P[at, : self.width]
        late = at >= self._row
        row = self._row
        rows[late, row:] -= self._sweeping[:, at[late]].T @ self._sweeping[:, row:]
        rows -= self._waiting[:, at].T @ self._waiting
        return self.mean[at], rows

    def write(self, at: NDArray[np.int64], mean: Array, rows: Array) -> None:
        """Set mean and rows, and with them columns, of the covariance at some numbers."""
        self.mean[at] = mean
        self._P[at, : self.width] = rows
        self._P[: self.width, at] = rows.T
        self._sweeping[:, at] = 0.0
        self._waiting[:, at] = 0.0

    def blocks(self, places: list[int]) -> Array:
        """Covariances (N, 2, 2) of the features at some places, up to date."""
        at = 2 * np.array(places, dtype=np.int64)[:, None] + np.arange(2)
        found = self._P[at[:, :, None], at[:, None, :]]
        swept = np.where(at[:, 0] >= self._row, 1.0, 0.0)[:, None, None]
        found -= swept * np.einsum('kia,kib->iab', self._sweeping[:, at], self._sweeping[:, at])
        return np.asarray(
            found - np.einsum('kia,kib->iab', self._waiting[:, at], self._waiting[:, at])
        )

    def subtract(self, W: Array) -> None:
        """Take W' W off the covariance, in time; W (R, width)."""
        self._waiting = np.vstack([self._waiting, W])

    def sweep(self) -> None:
        """Work some rows, and with them columns, off."""
        if len(self._sweeping) == 0:
            self._sweeping, self._waiting, self._row = self._waiting, self._sweeping, 0
        if len(self._sweeping) == 0:
            return
        # Rows grow shorter to the diagonal, so a step's share is one of the triangle; shares are
        # saved up for a block.
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
    """Zeros (size, size) that take up memory only where they are written.

    Not by numpy: that asks for large pages, of which each line of the few numbers in use would take
    up its share.
    """
    pages = mmap.mmap(-1, 8 * size * size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(AttributeError, OSError):  # where there are no large pages
        pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype=np.float64).reshape(size, size)


def widened(rows: Array, width: int) -> Array:
    """Rows (R, W) with zeros added up to a width."""
    return np.pad(rows, ((0, 0), (0, width - rows.shape[1])))
