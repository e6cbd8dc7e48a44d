#!/usr/bin/env bash
# Paper 2, Fig. 10: an exploration with its probabilities. From the bags: scripts/experiments/exploration.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" exploration "$@"
