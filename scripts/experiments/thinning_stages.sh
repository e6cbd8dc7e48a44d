#!/usr/bin/env bash
# Paper 2, Fig. 2: stages of thinning. From the bags: scripts/experiments/thinning_stages.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" thinning_stages "$@"
