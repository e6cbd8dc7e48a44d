#!/usr/bin/env bash
# Paper 3, Fig. 13: time against the number of features. From the bags: scripts/experiments/feature_count.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" feature_count "$@"
