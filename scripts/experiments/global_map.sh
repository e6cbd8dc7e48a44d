#!/usr/bin/env bash
# Paper 1, Fig. 6 to 9: local maps become the global one. From the bags: scripts/experiments/global_map.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" global_map "$@"
