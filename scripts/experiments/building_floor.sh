#!/usr/bin/env bash
# Paper 3, Fig. 7, 8, 11 and 12: a building floor by both filters. From the bags: scripts/experiments/building_floor.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" building_floor "$@"
