#!/usr/bin/env bash
# Paper 3, Fig. 14: 70 x 10 m over twenty minutes. From the bags: scripts/experiments/long_floor.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" long_floor "$@"
