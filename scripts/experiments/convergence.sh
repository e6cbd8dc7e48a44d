#!/usr/bin/env bash
# Paper 1, Fig. 10 and 11: 5,000 samples converge. From the bags: scripts/experiments/convergence.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" convergence "$@"
