#!/usr/bin/env bash
# Logs of real robots: scripts/experiments/logs.sh --logs FOLDER
exec "$(dirname "${BASH_SOURCE[0]}")/run" logs "$@"
