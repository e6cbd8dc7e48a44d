"""Reference EKF-SLAM with dense matrices, to test the fast filters."""

import math

import numpy as np

from thinmap_ros.core.ekf_slam.features import motion_jacobians, observe_line, place_line
from thinmap_ros.core.se2 import compose, wrap


class DenseFilter:
    """State x (3 + 2 N,) and P: pose and lines; textbook formulas over the whole state."""

    def __init__(self, pose, covariance):
        self.x = np.array(pose, dtype=float)
        self.P = np.array(covariance, dtype=float)

    def predict(self, increment, Q):
        F = np.eye(self.x.size)
        G = np.zeros((self.x.size, 3))
        F[:3, :3], G[:3] = motion_jacobians(self.x[:3], increment)
        self.P = F @ self.P @ F.T + G @ Q @ G.T
        self.x[:3] = compose(self.x[:3], increment)

    def update(self, indices, z, R):
        H = np.zeros((2 * len(indices), self.x.size))
        v = np.zeros(2 * len(indices))
        noise = np.zeros((v.size, v.size))
        for k, i in enumerate(indices):
            rows = slice(2 * k, 2 * k + 2)
            at = slice(3 + 2 * i, 5 + 2 * i)
            expected, H[rows, :3], H[rows, at] = observe_line(self.x[:3], self.x[at])
            v[rows] = z[k, 0] - expected[0], wrap(float(z[k, 1] - expected[1]))
            noise[rows, rows] = R[k]
        self._correct(H, v, noise)

    def merge(self, a, b, R):
        H = np.zeros((2, self.x.size))
        opposed = abs(wrap(float(self.x[4 + 2 * a] - self.x[4 + 2 * b]))) > math.pi / 2.0
        H[:, 3 + 2 * a : 5 + 2 * a] = np.eye(2)
        H[:, 3 + 2 * b : 5 + 2 * b] = np.diag([1.0 if opposed else -1.0, -1.0])
        v = -H @ self.x
        v[1] = wrap(float(v[1] + (math.pi if opposed else 0.0)))
        self._correct(H, v, R)

    def add(self, seen, R):
        line, by_pose, by_seen = place_line(self.x[:3], seen)
        n = self.x.size
        G = np.zeros((n + 2, n))
        G[:n, :n] = np.eye(n)
        G[n:, :3] = by_pose
        self.P = G @ self.P @ G.T
        self.P[n:, n:] += by_seen @ R @ by_seen.T
        self.x = np.append(self.x, line)

    def remove(self, index):
        keep = np.delete(np.arange(self.x.size), [3 + 2 * index, 4 + 2 * index])
        self.x = self.x[keep]
        self.P = self.P[np.ix_(keep, keep)]

    def _correct(self, H, v, R):
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        self.x = self.x + K @ v
        self.P = (np.eye(self.x.size) - K @ H) @ self.P
        self.x[2] = wrap(float(self.x[2]))
        self.x[4::2] = wrap(self.x[4::2])
