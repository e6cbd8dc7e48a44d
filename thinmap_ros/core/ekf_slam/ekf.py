"""EKF-SLAM over a pose and line features: the conventional filter, and EKF-SLAM/TI.

Source: EKF-SLAM/TI paper section 2, eqs. (1)-(11).
State [x, y, theta, r_1, alpha_1, r_2, alpha_2, ...].
"""

import math
import mmap
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.ekf_slam.features import motion_jacobians, observe_line, place_line
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.jit import kernel


class EkfSlam:
    """The filter. Features are addressed by their index in the state, 0 to count - 1.

    Between pose and features the state may hold `carried` numbers, which no observation or motion
    model depends on. Updates change them only by their correlations: see `CompressedEkf`.
    """

    def __init__(self, T_map_base: Array, covariance: Array, carried: int = 0) -> None:
        self.first = 3 + carried  # index of the first feature's r
        self._x: Array = np.zeros(self.first + 2 * 32)
        self._P: Array = np.zeros((self._x.size, self._x.size))
        self.count = 0
        self.set_pose(T_map_base, covariance)

    @property
    def size(self) -> int:
        """Dimension of the state."""
        return self.first + 2 * self.count

    @property
    def pose(self) -> Array:
        """T_map_base (3,), a copy."""
        return self._x[:3].copy()

    @property
    def pose_covariance(self) -> Array:
        """Covariance (3, 3) of the pose, a copy."""
        return self._P[:3, :3].copy()

    @property
    def covariance(self) -> Array:
        """Covariance of the whole state, a copy."""
        return self._P[: self.size, : self.size].copy()

    @property
    def lines(self) -> Array:
        """Lines (count, 2) as (r, alpha), a view of the state."""
        return self._x[self.first : self.size].reshape(-1, 2)

    @property
    def mean(self) -> Array:
        """The whole state, a copy."""
        return self._x[: self.size].copy()

    def place(self, index: int) -> slice:
        """Indices of a feature in the state."""
        return slice(self.first + 2 * index, self.first + 2 * index + 2)

    def line_covariances(self) -> Array:
        """Covariances (count, 2, 2) of the lines."""
        at = self.first + 2 * np.arange(self.count)[:, None] + np.arange(2)
        return np.asarray(self._P[at[:, :, None], at[:, None, :]])

    def set_state(self, mean: Array, covariance: Array) -> None:
        """Set the whole state (size,) and its covariance (size, size).

        All numbers after the pose and the carried ones are features.
        """
        n = mean.size
        self._reserve(n)
        self.count = (n - self.first) // 2
        self._x[:n] = mean
        self._P[:n, :n] = covariance

    def set_pose(self, T_map_base: Array, covariance: Array) -> None:
        """Set the pose (3,) with covariance (3, 3), uncorrelated with the features."""
        n = self.size
        self._x[:3] = T_map_base
        self._x[2] = wrap(float(T_map_base[2]))
        self._P[:3, :n] = 0.0
        self._P[:n, :3] = 0.0
        self._P[:3, :3] = 0.5 * (covariance + covariance.T)

    def predict(self, T_map_base: Array, increment: Array, increment_covariance: Array) -> None:
        """Move to T_map_base = pose o increment of covariance (3, 3), by eqs. (10) and (11).

        Only the pose moves, so only the pose's rows and columns of P change.
        """
        F_x, F_u = motion_jacobians(self._x[:3], increment)
        n = self.size
        self._P[:3, 3:n] = F_x @ self._P[:3, 3:n]
        self._P[3:n, :3] = self._P[:3, 3:n].T
        own = F_x @ self._P[:3, :3] @ F_x.T + F_u @ increment_covariance @ F_u.T
        self._P[:3, :3] = 0.5 * (own + own.T)
        self._x[:3] = T_map_base

    def innovations(self, index: int) -> tuple[Array, Array, Array]:
        """Expected observation (2,) of a feature, H P H' (2, 2), and H (2, 5) by pose and line."""
        expected, by_pose, by_line = observe_line(self._x[:3], self.lines[index])
        first = self.first + 2 * index
        at = [0, 1, 2, first, first + 1]
        H = np.hstack([by_pose, by_line])
        return expected, H @ self._P[np.ix_(at, at)] @ H.T, H

    def update(self, indices: NDArray[np.int64], z: Array, R: Array) -> bool:
        """Update by observations z (M, 2) of features (M,) with covariances R (M, 2, 2).

        Returns False, and changes nothing, if the innovation covariance is not positive definite.
        H has five nonzero columns per line, so H P needs these rows of P only.
        Source: eqs. (6)-(9).
        """
        if len(indices) == 0:
            return True
        n = self.size
        m = 2 * len(indices)
        v = np.empty(m)
        S = np.zeros((m, m))
        HP = np.empty((m, n))
        P = self._P[:n, :n]
        jacobians = []
        for k, index in enumerate(indices):
            rows = slice(2 * k, 2 * k + 2)
            at = self.place(int(index))
            expected, by_pose, by_line = observe_line(self._x[:3], self._x[at])
            v[rows] = _difference(z[k], expected)
            HP[rows] = by_pose @ P[:3] + by_line @ P[at]
            jacobians.append((at, by_pose, by_line))
        for k, (at, by_pose, by_line) in enumerate(jacobians):
            rows = slice(2 * k, 2 * k + 2)
            S[:, rows] = HP[:, :3] @ by_pose.T + HP[:, at] @ by_line.T
            S[rows, rows] += R[k]
        return self._correct(v, S, HP)

    def merge(self, kept: int, dropped: int, covariance: Array) -> bool:
        """Constrain two features to be equal, with covariance (2, 2).

        Returns whether the update was possible.
        """
        n = self.size
        a = self.place(kept)
        b = self.place(dropped)
        v, S, signs = self.difference(kept, dropped)
        return self._correct(-v, S + covariance, self._P[a, :n] - signs[:, None] * self._P[b, :n])

    def difference(self, a: int, b: int) -> tuple[Array, Array, Array]:
        """Line a minus line b, (2,), its covariance (2, 2), and the signs (2,) of b's r and alpha.

        (r, alpha) and (-r, alpha + pi) are the same line; the form of b nearer to a is used.
        """
        at_a = self.place(a)
        at_b = self.place(b)
        v, signs = line_difference(self._x[at_a], self._x[at_b])
        cross = self._P[at_a, at_b] * signs
        S = self._P[at_a, at_a] + signs[:, None] * self._P[at_b, at_b] * signs - cross - cross.T
        return v, S, signs

    def add(self, seen: Array, covariance: Array) -> int:
        """Add an observed line (r, alpha), robot frame, as a feature; returns its index.

        covariance (2, 2): of the observation.
        """
        n = self.size
        self._reserve(n + 2)
        line, by_pose, by_seen = place_line(self._x[:3], seen)
        self._x[n : n + 2] = line
        self._P[n : n + 2, :n] = by_pose @ self._P[:3, :n]
        self._P[:n, n : n + 2] = self._P[n : n + 2, :n].T
        own = by_pose @ self._P[:3, :3] @ by_pose.T + by_seen @ covariance @ by_seen.T
        self._P[n : n + 2, n : n + 2] = 0.5 * (own + own.T)
        self.count += 1
        return self.count - 1

    def remove(self, index: int) -> None:
        """Remove a feature; the indices of those behind it decrease by one."""
        keep = np.delete(np.arange(self.size), np.r_[self.place(index)])
        n = keep.size
        self._x[:n] = self._x[keep]
        self._P[:n, :n] = self._P[np.ix_(keep, keep)]
        self.count -= 1

    def _correct(self, v: Array, S: Array, HP: Array) -> bool:
        """Update with the innovation v (M,), its covariance S (M, M), and H P (M, size).

        Kalman gain K = P H' S^-1, eqs. (8) and (9); state x += K v, eq. (6); covariance
        P -= K H P, eq. (7).
        """
        taken = bool(_correct(0.5 * (S + S.T), HP, v, self._x, self._P))
        if taken:  # wrap angles into (-pi, pi]
            # A negative r is kept: reversing the line would also exchange the ends of its interval.
            self._x[2] = wrap(float(self._x[2]))
            self.lines[:, 1] = wrap(self.lines[:, 1])
        return taken

    def _reserve(self, size: int) -> None:
        if size > self._x.size:
            more = max(size - self._x.size, self._x.size)
            self._x = np.pad(self._x, (0, more))
            self._P = np.pad(self._P, (0, more))


def _difference(seen: Array, expected: Array) -> Array:
    return np.array([seen[0] - expected[0], wrap(float(seen[1] - expected[1]))])


def line_difference(a: Array, b: Array) -> tuple[Array, Array]:
    """Line a (r, alpha) minus the nearer form of line b, and the signs (2,) of b's r and alpha."""
    v = _difference(a, b)
    if abs(v[1]) <= 0.5 * math.pi:
        return v, np.ones(2)
    return np.array([a[0] + b[0], wrap(float(v[1] + math.pi))]), np.array([-1.0, 1.0])


@kernel
def _correct(S: Array, HP: Array, v: Array, x: Array, P: Array) -> bool:
    """Update x and P in place; returns False without a change if S is not positive definite.

    With S = L L', W = L^-1 H P and w = L^-1 v the gain need not be formed: K v = W' w, and
    K (H P) = W' W, which is exactly symmetric. S, HP and v are overwritten.
    """
    m, n = HP.shape
    for j in range(m):
        for k in range(j):
            for i in range(j, m):
                S[i, j] -= S[i, k] * S[j, k]
        if not S[j, j] > 1e-18 or not math.isfinite(S[j, j]):
            return False
        root = math.sqrt(S[j, j])
        for i in range(j, m):
            S[i, j] /= root
    for i in range(m):
        for k in range(i):
            v[i] -= S[i, k] * v[k]
            for c in range(n):
                HP[i, c] -= S[i, k] * HP[k, c]
        v[i] /= S[i, i]
        for c in range(n):
            HP[i, c] /= S[i, i]
        if not math.isfinite(v[i]):
            return False
    for i in range(n):
        row = P[i]
        for k in range(m):
            weight = HP[k, i]
            x[i] += weight * v[k]
            for j in range(n):
                row[j] -= weight * HP[k, j]
    return True


# Of the store of all features.
_ROOM = 8200  # numbers by which it grows; memory is used only where it is written
_CHUNK = 256  # numbers by which its used width grows
_SWEEP_STEPS = 384  # steps in which -W' W is added to all of it
_BLOCK = 64  # smallest number of rows to update at once

_ROUNDING = 1e-15  # relative size of an eigenvalue below which it is rounding error


class CompressedEkf:
    """EKF-SLAM/TI: the conventional filter's estimate at a cost independent of the feature count.

    The caller chooses the ids of features. `local` is the filter of the pose and the features of a
    local area, A. `area` lists their ids, in its order; change their number only by `add` and
    `remove` of this class. Until `set_local_area` is called, all features are in the area, and this
    is the conventional filter.

    Each step updates the pose and the features of the area. Its effect on all other features, B, is
    accumulated in a few numbers, and applied when the area changes. Let P_AB and P_BB be the
    covariances when the area was set. Then after any number of steps there is a vector c and a
    matrix C with x_B = x_B + P_BA c and P_BB = P_BB + P_BA C P_AB, and each number a of A has the
    cross covariance P_aB = Phi_a P_AB. A vector e with mean 0, covariance 0 and cov(A, e) = I at
    that time evolves in the same way (B changes as P_BA e): its mean is c, its covariance C, and
    its cross covariance Phi. So the local filter is the conventional filter with e as part of its
    state, without a second set of equations.

    Adding P_BA C P_AB to P_BB costs the square of the number of features. C is negative
    semidefinite, so the term is -W' W with few rows. Only the rows of a new area are updated at
    once. The others follow a few at a time, so that the time of each step is bounded.
    Source: EKF-SLAM/TI paper section 4 for the area; the compressed filter after Guivant and Nebot,
    "Optimization of the simultaneous localization and map-building algorithm for real-time
    implementation", 2001 (the paper's reference [4]).
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
        ids, lines = self.line_array()
        return dict(zip(ids.tolist(), lines, strict=True))

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
