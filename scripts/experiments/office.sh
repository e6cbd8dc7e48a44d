#!/usr/bin/env bash
# Paper 3, Fig. 10: the map of an office. From the bags: scripts/experiments/office.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" office "$@"
