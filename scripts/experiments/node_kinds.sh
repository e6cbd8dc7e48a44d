#!/usr/bin/env bash
# Paper 2, Fig. 3 and 4: end, branch and corner nodes. From the bags: scripts/experiments/node_kinds.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" node_kinds "$@"
