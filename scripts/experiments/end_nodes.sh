#!/usr/bin/env bash
# Paper 2, Fig. 5 and 6: end nodes move. From the bags: scripts/experiments/end_nodes.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" end_nodes "$@"
