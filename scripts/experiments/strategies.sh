#!/usr/bin/env bash
# Paper 2: position probability against other strategies. From the bags: scripts/experiments/strategies.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" strategies "$@"
