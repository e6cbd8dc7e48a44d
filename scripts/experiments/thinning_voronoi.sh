#!/usr/bin/env bash
# Paper 1, Fig. 3 and 4: thinning against the Voronoi diagram. From the bags: scripts/experiments/thinning_voronoi.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" thinning_voronoi "$@"
