"""EKF-SLAM/TI against the conventional filter: the same estimate up to rounding errors."""

from pathlib import Path

import numpy as np
import pytest
from reference_filter import DenseFilter

from thinmap_ros.core.ekf_slam.ekf import CompressedEkf, EkfSlam, _Store
from thinmap_ros.core.ekf_slam.features import observe_line
from thinmap_ros.core.se2 import compose

STATUS = Path('/proc/self/status')
P0 = np.diag([0.01, 0.02, 0.003])
Q = np.diag([1e-4, 5e-5, 4e-5])
R = np.array([[4e-4, 1e-5], [1e-5, 1e-4]])


class Pair:
    """Both filters with the same input; features by id."""

    def __init__(self, reference):
        self.whole = reference
        self.local = CompressedEkf(np.array([1.0, -2.0, 0.4]), P0)
        self.ids = []

    def add(self, seen):
        self.ids.append(max(self.ids, default=0) + 1)
        self.local.add(self.ids[-1], seen, R)
        self.whole.add(seen, R)

    def remove(self, feature_id):
        self.local.remove(self.local.area.index(feature_id))
        self.whole.remove(self.ids.index(feature_id))
        self.ids.remove(feature_id)

    def predict(self, increment):
        self.local.local.predict(compose(self.local.local.pose, increment), increment, Q)
        if isinstance(self.whole, EkfSlam):
            self.whole.predict(compose(self.whole.pose, increment), increment, Q)
        else:
            self.whole.predict(increment, Q)

    def update(self, rng, ids):
        local = self.local.local
        indices = np.array([self.local.area.index(i) for i in ids], dtype=np.int64)
        z = np.array([observe_line(local.pose, local.lines[k])[0] for k in indices]).reshape(-1, 2)
        z = z + rng.multivariate_normal([0.0, 0.0], R, len(z))
        noise = np.tile(R, (len(z), 1, 1))
        assert local.update(indices, z, noise)
        self.whole.update(np.array([self.ids.index(i) for i in ids], dtype=np.int64), z, noise)

    def assert_same(self):
        mean, covariance = self.local.flush()
        at = np.concatenate(
            [np.arange(3)] + [3 + 2 * self.ids.index(i) + np.arange(2) for i in self.local.ids]
        )
        conventional = isinstance(self.whole, EkfSlam)
        whole = self.whole
        x, P = (whole.mean, whole.covariance) if conventional else (whole.x, whole.P)
        np.testing.assert_allclose(mean, x[at], atol=1e-9)
        np.testing.assert_allclose(covariance, P[np.ix_(at, at)], atol=1e-9)


def new_line(rng):
    return np.array([rng.uniform(0.5, 8.0), rng.uniform(-3.1, 3.1)])


def run(pair, rng, steps, area_every, change):
    """A robot drives through several areas; features are observed, added and removed."""
    for _ in range(20):
        pair.add(new_line(rng))
    for step in range(steps):
        pair.predict(rng.normal(0.0, [0.2, 0.02, 0.1]))
        area = pair.local.area
        pair.update(rng, rng.permutation(area)[: rng.integers(0, 4)])
        if step % change == 4:
            pair.add(new_line(rng))
        if step % change == 9 and len(area) > 2:
            pair.remove(area[rng.integers(len(area))])
        if step % area_every == area_every - 1:
            number = rng.integers(1, 8)
            pair.local.set_local_area(list(rng.permutation(pair.local.ids)[:number]))
        pair.local.flush_step()


def test_the_same_estimate_as_the_textbook_over_many_areas(rng):
    pair = Pair(DenseFilter(np.array([1.0, -2.0, 0.4]), P0))
    run(pair, rng, 150, 7, 20)
    pair.assert_same()


@pytest.mark.parametrize(('area_every', 'change'), [(10, 15), (3, 40), (120, 11)])
def test_the_same_estimate_as_the_full_filter_over_a_thousand_steps(rng, area_every, change):
    pair = Pair(EkfSlam(np.array([1.0, -2.0, 0.4]), P0))
    run(pair, rng, 1000, area_every, change)
    assert len(pair.ids) > 20
    pair.assert_same()


def test_more_features_than_a_chunk_of_the_store(rng):
    """Pending sweeps of several areas, while the store grows."""
    pair = Pair(EkfSlam(np.array([1.0, -2.0, 0.4]), P0))
    for _ in range(200):
        pair.add(new_line(rng))
    for step in range(60):
        if step % 6 == 0:
            pair.local.set_local_area(list(rng.permutation(pair.local.ids)[:10]))
        pair.predict(rng.normal(0.0, [0.2, 0.02, 0.1]))
        pair.update(rng, rng.permutation(pair.local.area)[:3])
        pair.add(new_line(rng))
        for _ in range(step % 40):
            pair.local.flush_step()
    pair.assert_same()


def test_a_pose_that_is_set_is_that_of_the_full_filter(rng):
    pair = Pair(EkfSlam(np.array([1.0, -2.0, 0.4]), P0))
    run(pair, rng, 40, 10, 30)
    for filter_ in (pair.local.local, pair.whole):
        filter_.set_pose(np.array([0.5, 0.6, 0.7]), P0)
    pair.update(rng, pair.local.area[:1])
    pair.assert_same()


def test_lines_and_covariances_outside_the_area(rng):
    """Lines and covariances outside the area are those of the time when it was set."""
    pair = Pair(EkfSlam(np.array([1.0, -2.0, 0.4]), P0))
    run(pair, rng, 60, 10, 30)
    ids = pair.local.ids
    pair.local.set_local_area(ids[:3])
    lines = pair.local.lines()
    covariances = pair.local.line_covariances()
    at = [pair.ids.index(i) for i in ids]
    np.testing.assert_allclose([lines[i] for i in ids], pair.whole.lines[at], atol=1e-9)
    np.testing.assert_allclose(
        [covariances[i] for i in ids], pair.whole.line_covariances()[at], atol=1e-9
    )


def test_steps_touch_the_local_area_only(rng):
    """The local filter has a state of pose, area and as many carried numbers, for any map size."""
    pair = Pair(EkfSlam(np.array([1.0, -2.0, 0.4]), P0))
    for _ in range(300):
        pair.add(new_line(rng))
    pair.local.set_local_area(pair.local.ids[:8])
    assert pair.local.local.size == 2 * (3 + 2 * 8)
    assert len(pair.local) == 300


@pytest.mark.skipif(
    not STATUS.exists(), reason='says what a process holds only where there is a /proc'
)
def test_a_fold_of_some_hundred_features_is_worked_in_over_some_hundred_steps(rng):
    store = _Store()
    for _ in range(500):
        store.take_place()
    at = np.arange(1000)
    W = np.zeros((3, store.width))
    W[:, :1000] = rng.normal(0.0, 0.1, (3, 1000))
    store.subtract(W)
    _, up_to_date = store.read(at)
    steps = 0
    while len(store._waiting) + len(store._sweeping) > 0:
        store.sweep()
        steps += 1
    assert 250 < steps < 450
    np.testing.assert_allclose(store._P[:1000, :1000], up_to_date[:, :1000], atol=1e-12)


def test_some_hundred_features_take_little_memory(rng):
    """Their covariance is 2 MB; the reserved memory of the store must not be used."""
    before = held_mb()
    ekf = CompressedEkf(np.array([1.0, -2.0, 0.4]), P0)
    for feature_id in range(250):
        ekf.add(feature_id, new_line(rng), R)
    ekf.set_local_area([0, 1])
    assert held_mb() - before < 14.0


def held_mb():
    """Private memory of this process, MB."""
    return next(
        int(line.split()[1]) / 1e3 for line in STATUS.read_text().splitlines() if 'RssAnon' in line
    )
