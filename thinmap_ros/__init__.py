"""thinmap: thinning-based topological mapping, exploration, SLAM for robots with one 2D laser."""

import os

# Matrices here are small: sharing one among threads costs more than it saves, ten times in the
# filter, and sums in another order on every number of cores, so that the same log gives other last
# digits. It counts if NumPy comes later.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
