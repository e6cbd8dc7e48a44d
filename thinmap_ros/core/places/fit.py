"""Share of a scan that a map explains from the right place, by scans simulated in that map."""

from dataclasses import replace

import numpy as np

from thinmap_ros.core.places.config import GlobalLocalizationConfig
from thinmap_ros.core.places.likelihood import HEADING_NOISE_RAD, Judge
from thinmap_ros.core.places.observation import observed_beams
from thinmap_ros.core.places.observation_model import random_pose, simulated_scan
from thinmap_ros.core.places.place_database import Places
from thinmap_ros.core.scan import Scan

_TRIALS = 400  # where walls are smooth, few places leave anything unexplained
_MIN_RATIO = 0.7  # whatever the map looks like: what explains less is not the right place


def usual_share(
    places: Places,
    judge: Judge,
    like: Scan,
    config: GlobalLocalizationConfig,
    rng: np.random.Generator,
) -> float:
    """Share of beams that the map explains from the right place, of those it says something about.

    like: a scan of the laser in question. Scans are made in the map at random poses, with noise,
    and compared from poses that are as far off as those of a hypothesis where all is well. Smooth
    walls round empty rooms explain nearly all; a map in which there are legs of chairs, and edges
    wherever somebody went by, a good deal less.
    """
    counts = 0.0
    asked = 0.0
    for _ in range(_TRIALS):
        T = random_pose(places, rng)
        scan = simulated_scan(places, T, like)
        noisy = scan.ranges_m + rng.normal(0.0, config.beam_noise_m, scan.ranges_m.size)
        seen = observed_beams(replace(scan, ranges_m=noisy), config)
        noise = (config.map_noise_m, config.map_noise_m, HEADING_NOISE_RAD)
        off = rng.normal(size=3) * noise
        explained, silent = judge.explained((T + off)[None], seen)
        counts += float(explained[0])
        asked += len(seen.ranges_m) - float(silent[0])
    return max(counts / max(asked, 1.0), _MIN_RATIO)
