"""EKF-SLAM over a pose and line features: the conventional filter.

Source: EKF-SLAM/TI paper section 2, eqs. (1)-(11).
State [x, y, theta, r_1, alpha_1, r_2, alpha_2, ...].
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.ekf_slam.features import motion_jacobians, observe_line, place_line
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.jit import kernel


class EkfSlam:
    """The filter. Features are addressed by their index in the state, 0 to count - 1.

    Between pose and features the state may hold `carried` numbers, which no observation or motion
    model depends on. Updates change them only by their correlations: see ekf_ti for their use.
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
        if taken:
            self._normalise()
        return taken

    def _reserve(self, size: int) -> None:
        if size <= self._x.size:
            return
        wider = max(size, 2 * self._x.size)
        x = np.zeros(wider)
        P = np.zeros((wider, wider))
        n = self.size
        x[:n] = self._x[:n]
        P[:n, :n] = self._P[:n, :n]
        self._x = x
        self._P = P

    def _normalise(self) -> None:
        """Wrap angles into (-pi, pi].

        A negative r is kept: reversing the line would also exchange the ends of its interval.
        """
        self._x[2] = wrap(float(self._x[2]))
        self.lines[:, 1] = wrap(self.lines[:, 1])


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
