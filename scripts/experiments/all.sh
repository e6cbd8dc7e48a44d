#!/usr/bin/env bash
# All of the papers' experiments. From the bags: scripts/experiments/all.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" all "$@"
