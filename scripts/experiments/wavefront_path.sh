#!/usr/bin/env bash
# Paper 1, section 3.2: the wavefront path. From the bags: scripts/experiments/wavefront_path.sh --from-bag bags
exec "$(dirname "${BASH_SOURCE[0]}")/run" wavefront_path "$@"
